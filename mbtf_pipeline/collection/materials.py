"""Finds the materials of a library, and names them."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from itertools import chain, count
from pathlib import Path
from typing import Any

from mbtf_core.config.yaml_file import read_yaml
from mbtf_core.errors import InputError, UsageError, reason
from mbtf_core.paths import named_file, real_path
from mbtf_pipeline.recipe import texts_of

# Files in a folder of materials that are materials.
_SUFFIXES = {".yaml", ".yml", ".pyp", ".bcc", ".curves", ".glb", ".gltf", ".ply", ".obj"}
_YAML = (".yaml", ".yml")
# Records of folders that the programs have written, and keys of recipes.
_RECORDS = {"collection.json", "run.json", "manifest.json", "fit.json"}
_RECIPE_KEYS = {"library", "generate"}
# Characters of a name besides its number.
_LONGEST = 90


def find_materials(path: Path) -> list[Path]:
    """Materials of an entry of ``library``: a material, a folder of them, or a list of paths; an InputError
    where a list cannot be read.

    Those of a folder and the folders below it are sorted. Files that a YAML file beside them names are parts
    of its material. Recipes and outputs of the programs are no materials.
    """
    path = Path(os.path.normpath(path))
    if path.is_dir():
        return _in_folder(path)
    if path.suffix != ".txt" or not path.is_file():
        return [path]
    try:
        lines = [line.strip() for line in path.read_text(encoding="utf-8-sig").splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read as a list ({reason(error)})", where=path) from None
    if any("\0" in line for line in lines):
        raise InputError("is no list of paths: it holds null characters", where=path)
    named = (named_file(path.parent, line) for line in lines if line and not line.startswith("#"))
    return [Path(os.path.normpath(material)) for material in named]


def _in_folder(folder: Path) -> list[Path]:
    """A folder that is a material, or the materials in it; their runs say whether they are usable."""
    from mbtf_core.images.read import is_image
    from mbtf_gen.tile.maps.file_names import role_of

    inside = [path for path in sorted(folder.iterdir()) if not path.name.startswith((".", "_"))]
    files = {path.name for path in inside if path.is_file()}
    images = [name for name in files if is_image(Path(name))]
    if files & {"material.yaml", "material.yml"} or any(role_of(name) == "height" for name in images):
        return [folder]
    documents = {path: _document(path) for path in inside if path.suffix.lower() in _YAML and path.is_file()}
    texts = {data[key] for document in documents.values() for data, key, _ in texts_of(document)}
    parts = {os.path.normpath(named_file(folder, text)) for text in texts if "\0" not in text}
    out: list[Path] = []
    for path in inside:
        if path.is_dir():
            loops = path.is_symlink() and real_path(folder).is_relative_to(real_path(path))
            if not loops and not any((path / name).is_file() for name in _RECORDS):
                out += _in_folder(path)
        elif path.suffix.lower() in _SUFFIXES and not (
            os.path.normpath(path) in parts or _RECIPE_KEYS & documents.get(path, {}).keys()
        ):
            out.append(path)
    # Pictures beside materials are something else; alone, they may be meant as maps.
    return out or ([folder] if images else [])


def _document(path: Path) -> Mapping[str, Any]:
    """Content of a YAML file; nothing where it is faulty, which its run says."""
    try:
        found: Mapping[str, Any] = read_yaml(path)
    except InputError:
        return {}
    return found


def name_materials(paths: Sequence[Path], taken: Collection[str] = ()) -> list[str]:
    """Name of each material: that of its file or folder, and none of the names `taken`; a UsageError where a
    material is listed twice.

    Equal ones are prefixed by the parent's name, and numbered if they are still equal.
    """
    for real, listed in Counter(os.path.realpath(path) for path in paths).items():
        if listed > 1:
            raise UsageError("is listed twice", where=real, hint="list each material once in 'library'")
    plain = [_name(path.stem if path.suffix.lower() in _SUFFIXES else path.name) for path in paths]
    often, names = Counter([*plain, *taken]), [*taken]
    for name, path in zip(plain, paths, strict=True):
        base = name if often[name] == 1 else _name(f"{path.parent.name}-{name}")
        numbered = (f"{base}-{number}" for number in count(2))
        names.append(next(own for own in chain([base], numbered) if own not in names))
    return names[len(taken) :]


def _name(text: str) -> str:
    """A text as a name of a folder; the end of a long one."""
    return re.sub(r"[^A-Za-z0-9._+-]+", "_", text)[-_LONGEST:].lstrip("._+-") or "material"
