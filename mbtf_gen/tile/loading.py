"""Loads a material: a height map, a folder of maps, a ``material.yaml``, a mesh, or a file of fibers."""

from __future__ import annotations

import contextlib
import os
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

from mbtf_core.config.settings import build
from mbtf_core.config.yaml_file import line_of, read_yaml
from mbtf_core.data.schema import Tiling
from mbtf_core.errors import InputError, UsageError, check_type
from mbtf_core.files.atomic import file_sha256
from mbtf_core.images.limits import MAX_PIXELS
from mbtf_core.images.read import SUFFIXES, is_image
from mbtf_core.meshes.read import MESH_FILES
from mbtf_core.paths import named_file, suggest_path
from mbtf_gen.tile.assembly import assemble, retiled
from mbtf_gen.tile.cloth import cloth_tile
from mbtf_gen.tile.fibers.cloth_file import CLOTH_KEYS, CURVE_FILES, ClothFile
from mbtf_gen.tile.maps.discovery import FoundMaps, find_maps, unpack
from mbtf_gen.tile.maps.material_file import MaterialFile
from mbtf_gen.tile.mesh_file import MeshFile, read_mesh
from mbtf_gen.tile.protocol import Tile

Described = MaterialFile | ClothFile | MeshFile

# Files that are imported, not rendered.
MEASURED_FILES = (".btf", ".h5", ".hdf5")

# Terrains without a header that states their size and type.
_RAW = (".raw", ".r16", ".r32", ".hgt", ".bil", ".flt")
_RAW_HINT = (
    "convert it to a PNG of 16 bits or a TIFF, such as by gdal_translate, or in Python: "
    "numpy.save('h.npy', numpy.fromfile(FILE, '<u2').reshape(ROWS, COLUMNS))"
)

_YAML = ("material.yaml", "material.yml")

# Bytes of the maps up to which the latest tile is kept: a training process has no use for larger ones.
_KEPT_BYTES = 1 << 28
_kept: tuple[Any, Tile] | None = None


def load_material(path: str | Path, tiling: Tiling | None = None, max_pixels: int = MAX_PIXELS) -> Tile:
    """Load a material.

    Parameters
    ----------
    path : str or Path
        A height map, a ``material.yaml``, a folder that contains one or maps with customary names, a mesh
        (``.glb``, ``.gltf``, ``.ply``, ``.obj``), or a file of yarns or fibers (``.pyp``, ``.bcc``,
        ``.curves``, ``.txt``). Other maps beside a height map are ignored.
    tiling : {"none", "mirror", "blend"} or None
        Method for maps that do not tile. ``mirror``: 2 × 2 mirrored copies, a tile of twice the width;
        ``blend``: the edges blended over an eighth of the tile (:mod:`mbtf_gen.tile.maps.tiling`); None:
        that of the material file, else ``none``.
    max_pixels : int
        Larger maps are refused.

    Returns
    -------
    Tile

    Raises
    ------
    InputError
        A file is missing, unreadable or ambiguous, a value is out of range, or aspects differ.
    """
    check_type(path, (str, os.PathLike), "material", "give the path of a height map, a folder or a file")
    if tiling not in (None, *get_args(Tiling)):
        raise UsageError(f"'{tiling}' is none of {', '.join(get_args(Tiling))}", where="tiling")
    spec, folder, found = described(Path(path))
    return _load(spec, folder, found, spec.tiling(tiling), max_pixels)


def latest_material(path: str | Path, tiling: Tiling | None = None, max_pixels: int = MAX_PIXELS) -> Tile:
    """:func:`load_material`; maps are not decoded again while the contents of folder and files are the same.
    The tile is not to be changed: the next call may return it again."""
    global _kept
    spec, folder, found = described(Path(path))
    method = spec.tiling(tiling)
    # Loading adds notes to `found`.
    asked = (spec, folder, replace(found, notes=[*found.notes]), method)
    if _kept is not None and _kept[0] == asked and _unchanged(_kept[1]):
        return _kept[1]
    tile = _load(spec, folder, found, method, max_pixels)
    _kept = (asked, tile) if tile.nbytes <= _KEPT_BYTES else None
    return tile


def _unchanged(tile: Tile) -> bool:
    """Whether its files have the contents that it was loaded from."""
    try:
        return all(file_sha256(path) == tile.digests[role] for role, path in tile.files.items())
    except OSError:
        return False


def _load(spec: Described, folder: Path, found: FoundMaps, tiling: Tiling, max_pixels: int) -> Tile:
    if isinstance(spec, ClothFile):
        return cloth_tile(spec, folder)
    if isinstance(spec, MeshFile):
        return read_mesh(spec, folder)
    tile = assemble(spec, folder, found, tiling, max_pixels)
    return tile if tiling == "none" else retiled(tile, tiling, max_pixels)


def described(path: Path) -> tuple[Described, Path, FoundMaps]:
    """Material file of what :func:`load_material` loads, the folder that its file names are relative to, and
    the maps found there; an InputError if nothing usable is at the path."""
    path = named_file(Path(), str(path))
    if path.is_dir():
        described = next((path / name for name in _YAML if os.path.lexists(path / name)), None)
        if described is not None:
            return _read(described), path, FoundMaps()
        found = find_maps(path)
        spec = MaterialFile.model_validate(found.entries)
        return spec, path, found
    if not path.exists():
        raise InputError("no such file or folder", where=path, hint=suggest_path(path))
    suffix = path.suffix.lower()
    if suffix in (".yaml", ".yml"):
        return _read(path), path.parent, FoundMaps()
    if suffix in CURVE_FILES:
        return build(ClothFile, {CURVE_FILES[suffix]: path.name}, source=str(path)), path.parent, FoundMaps()
    if suffix in MESH_FILES:
        return build(MeshFile, {"mesh": path.name}, source=str(path)), path.parent, FoundMaps()
    if suffix in MEASURED_FILES:
        raise InputError("is a measured BTF", where=path, hint=f"import it: mbtf-gen import {path}")
    if not is_image(path):
        raise InputError(
            f"'{path.suffix}' is not read",
            where=path,
            hint=unpack(path)
            or (_RAW_HINT if suffix in _RAW else "")
            or f"give a folder, a .yaml file, or {', '.join((*SUFFIXES, *MESH_FILES, *CURVE_FILES))}",
        )
    spec = MaterialFile.model_validate({"height": path.name})
    notes = []
    with contextlib.suppress(InputError):
        others = {role: file for role, file in find_maps(path.parent).maps.items() if file != path}
        if others and "height" not in others:
            names = ", ".join(dict.fromkeys(file.name for file in others.values()))
            notes = [
                f"only the heights of {path.name} are used; for {names} too, give the folder {path.parent}"
            ]
    return spec, path.parent, FoundMaps(notes=notes)


def _read(path: Path) -> Described:
    document = read_yaml(path)
    if "mesh" in document:
        return build(MeshFile, document, source=str(path))
    if CLOTH_KEYS & document.keys():
        cloth = build(ClothFile, document, source=str(path))
        try:
            if cloth.weave is not None:
                _ = cloth.woven
        except InputError as fault:
            line = line_of(document, [str(fault.where)])
            raise InputError(fault.what, where=f"{path}:{line}: {fault.where}", hint=fault.hint) from None
        return cloth
    return build(MaterialFile, document, source=str(path))
