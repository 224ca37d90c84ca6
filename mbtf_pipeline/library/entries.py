"""A library recipe: where the materials lie, and the options of their runs."""

from __future__ import annotations

import os
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from mbtf_core.config.settings import FileName, Settings, build, deep_merge, resolve
from mbtf_core.config.yaml_file import read_yaml
from mbtf_core.errors import InputError, MbtfError, UsageError
from mbtf_core.units import Duration
from mbtf_fit.config import DEFAULT_MODEL, FIBER_MODEL, FitConfig
from mbtf_pipeline.layers import Layer, MaterialLayer, compose
from mbtf_pipeline.library.materials import find_materials, name_materials
from mbtf_pipeline.recipe import Name, Recipe


class LibraryRecipe(Settings):
    """Configuration of a library."""

    version: Literal[1] = 1
    name: Name
    title: str | None = Field(None, description="title of the page; default: the name")
    description: str = ""
    output: str | None = Field(None, description="folder; default: out/NAME")
    library: list[FileName] = Field(
        description="folders of materials, materials, and text files with one of them per line"
    )
    materials: dict[Name, MaterialLayer] = Field(
        {}, description="name → path or layer: further materials, and own options of those in `library`"
    )
    base: Layer = Field(
        description="options of all runs; without `fit`, the model that is best for each material"
    )
    training: Duration | None = Field(
        None,
        description="training time of each material, shared equally by its fits; default: theirs",
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
        The file cannot be read, or contains an unknown key or an invalid value, also in its options of runs.
    UsageError
        An assignment is invalid, or there is a training time of every material and one of a fit.
    """
    library = resolve(LibraryRecipe, file=path, assignments=assignments)
    if library.training is not None:
        _refuse_own_times(library)
    try:
        _check_base(library.base.model_dump(mode="json"), f"{path}: base")
    except InputError:
        # The same from the file, which has line numbers.
        _check_base(read_yaml(path).get("base") or {}, str(path))
        raise
    return library


def _refuse_own_times(library: LibraryRecipe) -> None:
    """Refuse training times of single fits beside one of every material."""
    layers = {"base": library.base, **{f"materials.{name}": one for name, one in library.materials.items()}}
    for where, layer in layers.items():
        fits = {"each_fit": layer.each_fit, **{f"fit.{name}": fit for name, fit in layer.fit.items()}}
        for fit, options in fits.items():
            training = (options or {}).get("training") or {}
            for key in ("time", "steps"):
                if isinstance(training, Mapping) and training.get(key) is not None:
                    hint = "leave out one of them"
                    what = "is a time of its own beside 'training', the time of each material"
                    raise UsageError(what, where=f"{where}.{fit}.training.{key}", hint=hint)


def _check_base(base: Mapping[str, Any], source: str) -> None:
    """Check the options of all runs once, in place of for every material."""
    # A copy, which keeps line numbers.
    data: Any = deepcopy(base)
    each = data.pop("each_fit", None) or {}
    data["name"] = "any"
    data["generate"] = data.get("generate") or {}
    data["generate"]["material"] = "any"
    fits = data.get("fit") or {DEFAULT_MODEL: None}
    data["fit"] = {name: deep_merge(each, {"model": name, **(own or {})}) for name, own in fits.items()}
    try:
        build(Recipe, data, source=source)
    except InputError:
        # A fault in `each_fit` has a line there.
        build(FitConfig, each, source=source)
        raise


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
        One is listed twice.
    """
    from mbtf_fit.material.decoder import DECODER_FOLDER

    found: dict[str, tuple[Path, Layer]] = {}
    paths = [file for text in library.library for file in find_materials(path.parent / text)]
    named = [name for name, layer in library.materials.items() if "material" in layer.generate]
    # Materials that share a network lie beside its folder.
    names = name_materials(paths, [*named, DECODER_FOLDER])
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
    try:
        str(file).encode()
    except UnicodeEncodeError:
        return Entry(name, file, None, "its path is not UTF-8 text: rename it")
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
    from mbtf_gen.tile.loading import described
    from mbtf_gen.tile.maps.material_file import MaterialFile

    return DEFAULT_MODEL if isinstance(described(file)[0], MaterialFile) else FIBER_MODEL
