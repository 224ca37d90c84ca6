"""A library recipe: where the materials lie, and the options of their runs."""

from __future__ import annotations

import os
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field

from mbtf_core.config_file import Settings, read_yaml, resolve
from mbtf_core.errors import InputError, MbtfError, UsageError, reason
from mbtf_core.units import Duration
from mbtf_fit.config import DEFAULT_MODEL, FIBER_MODEL
from mbtf_pipeline.layers import Layer, MaterialLayer, compose
from mbtf_pipeline.recipe import Name, Recipe

# Files in a folder of materials that are materials.
_SUFFIXES = {".yaml", ".yml", ".pyp", ".bcc", ".curves", ".glb", ".gltf", ".ply", ".obj", ".exr"}


class LibraryRecipe(Settings):
    """Configuration of a library."""

    version: Literal[1] = 1
    name: Name
    title: str | None = Field(None, description="title of the page; default: the name")
    description: str = ""
    output: str | None = Field(None, description="folder; default: out/NAME")
    library: list[str] = Field(
        description="folders of materials, materials, and text files with one of them per line"
    )
    materials: dict[Name, MaterialLayer] = Field(
        {}, description="name → path or layer: further materials, and own options of those in `library`"
    )
    base: Layer = Field(
        description="options of all runs; without `fit`, the model that is best for each material"
    )
    training: Duration | None = Field(
        None, description="training time of all fits together, more for larger errors; default: their own"
    )
    first_share: float = Field(
        0.2, gt=0, lt=1, description="share of `training` for equal first fits, whose errors divide the rest"
    )

    shared_network: Duration | None = Field(
        None, description="training time of further fits that share one network; default: none"
    )

    @property
    def folder(self) -> Path:
        """Default folder of the library, relative to the current folder."""
        return Path("out") / self.name if self.output is None else Path(self.output)


@dataclass(frozen=True)
class Entry:
    """A material of a library.

    Attributes
    ----------
    name : of its folder in the library
    path : of the material
    recipe : of its run; None where `error` says why there is none
    error : empty unless its options or files are at fault
    """

    name: str
    path: Path
    recipe: Recipe | None
    error: str = ""


def is_library_recipe(path: Path) -> bool:
    """Whether a file is a library recipe, that is, says where materials lie."""
    return path.is_file() and "library" in read_yaml(path)


def load_library_recipe(path: Path, assignments: list[str]) -> LibraryRecipe:
    """Read a library recipe.

    Parameters
    ----------
    path : Path
        YAML file.
    assignments : list of str
        ``a.b=c``; override values of the file.

    Returns
    -------
    LibraryRecipe

    Raises
    ------
    InputError
        The file cannot be read, or contains an unknown key or an invalid value.
    UsageError
        An assignment is invalid, or sets one training time of all fits and one of each.
    """
    return resolve(LibraryRecipe, file=path, assignments=assignments)


def entries(library: LibraryRecipe, path: Path) -> list[Entry]:
    """The materials of a library.

    Parameters
    ----------
    library : LibraryRecipe
        From :func:`load_library_recipe`.
    path : Path
        Its file; paths are relative to it.

    Returns
    -------
    list of Entry
        In the order of the recipe; those of one folder by name.

    Raises
    ------
    InputError
        There are none, or a list cannot be read.
    UsageError
        Two have the same name.
    """
    found: dict[str, tuple[Path, Layer]] = {}
    paths = [file for text in library.library for file in _materials(path.parent / text)]
    names = _names(paths)
    for name, file in zip(names, paths, strict=True):
        found[name] = (file, library.materials.get(name, Layer()))
    for name, layer in library.materials.items():
        own = layer.generate.get("material")
        if own is not None:
            found[name] = (Path(os.path.normpath(path.parent / str(own))), layer)
        elif name not in found:
            hint = "add generate.material, or correct the name"
            raise InputError("is no material of the library", where=f"{path}: materials.{name}", hint=hint)
    if not found:
        raise InputError("names no material", where=path, hint="add folders to 'library'")
    return [_entry(library, name, file, layer, path) for name, (file, layer) in found.items()]


def _entry(library: LibraryRecipe, name: str, file: Path, layer: Layer, path: Path) -> Entry:
    if not file.exists():
        return Entry(name, file, None, "does not exist")
    try:
        layers = [library.base, layer]
        if not (library.base.fit or layer.fit):
            layers.append(Layer(fit={_model_for(file): None}))
        return Entry(name, file, compose(layers, name, file, str(path)))
    except MbtfError as error:
        return Entry(name, file, None, " ".join(error.message.split()))


def _model_for(file: Path) -> str:
    """The model that is best for a material; that of heights traces them."""
    from mbtf_gen.material.load import described
    from mbtf_gen.material.spec import MaterialFile

    return DEFAULT_MODEL if isinstance(described(file)[0], MaterialFile) else FIBER_MODEL


def _materials(path: Path) -> list[Path]:
    """Materials of an entry of `library`."""
    path = Path(os.path.normpath(path))
    if path.suffix == ".txt" and path.is_file():
        try:
            lines = [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"cannot be read as a list ({reason(error)})", where=path) from None
        listed = [path.parent / line for line in lines if line and not line.startswith("#")]
        return [Path(os.path.normpath(file)) for file in listed]
    if not path.is_dir() or _is_material(path):
        return [path]
    inside = [p for p in sorted(path.iterdir()) if not p.name.startswith((".", "_"))]
    return [p for p in inside if (_is_material(p) if p.is_dir() else p.suffix.lower() in _SUFFIXES)]


def _is_material(folder: Path) -> bool:
    """Whether a folder holds maps or a description; whether they are usable is for its run to say."""
    from mbtf_gen.images.read import is_image

    return any(
        file.name in ("material.yaml", "material.yml") or is_image(file)
        for file in folder.iterdir()
        if file.is_file()
    )


def _names(paths: list[Path]) -> list[str]:
    """A name for each material, that of its file or folder; equal ones are prefixed by the parent's."""
    plain = [_name(path.stem if path.suffix.lower() in _SUFFIXES else path.name) for path in paths]
    often = Counter(plain)
    names = [
        name if often[name] == 1 else f"{_name(path.parent.name)}-{name}"
        for name, path in zip(plain, paths, strict=True)
    ]
    for name, count in Counter(names).items():
        if count > 1:
            hint = "list each once, or rename one"
            raise UsageError(f"{count} materials have the name {name}", where="library", hint=hint)
    return names


def _name(text: str) -> str:
    cleaned = re.sub(r"[^A-Za-z0-9._+-]+", "_", text).lstrip("._+-")
    return cleaned[:100] or "material"
