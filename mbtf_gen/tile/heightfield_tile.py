"""A material: the shape and the reflectance of one tile."""

from __future__ import annotations

import json
from collections.abc import Container
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mbtf_core.color import srgb_to_linear
from mbtf_core.digest import data_sha256, file_sha256
from mbtf_core.errors import InputError
from mbtf_core.lattice import Lattice
from mbtf_core.shard_schema import Tiling
from mbtf_core.suggest import suggest_path
from mbtf_gen.images.read import MAX_PIXELS, gray
from mbtf_gen.images.resample import dequantize, resample
from mbtf_gen.tile.fiber_tile import FiberTile
from mbtf_gen.tile.heights.grid import HeightGrid
from mbtf_gen.tile.maps.blending import BAND
from mbtf_gen.tile.maps.checks import (
    choose_convention,
    coarse_step,
    level_warning,
    normal_note,
    orientation_warning,
    refuse_color,
    seam_warning,
    suggestion_warning,
)
from mbtf_gen.tile.maps.discovery import Convention, FoundMaps, normal_convention
from mbtf_gen.tile.maps.map_loader import Color, MapFacts, MapLoader, Share
from mbtf_gen.tile.maps.material_file import MaterialFile, NormalEntry
from mbtf_gen.tile.maps.normal_map import NormalFit, fit_normals
from mbtf_gen.tile.maps.quantization import Codes, code_use
from mbtf_gen.tile.maps.tiling import Seam, retile, seams
from mbtf_gen.tile.mesh_tile import MeshTile

# Tile widths per stored height: the range of integer images is unknown, floats are in tile widths.
_INTEGER_SCALE, _FLOAT_SCALE = 0.05, 1.0
# Largest stored height; squares of larger ones are beyond float32.
_MOST = 1e15
# Displacement range, in tile widths, above which a default height scale is probably wrong.
_STEEP = 0.5
# Defaults of a glossy surface, and of the roughness of its layers.
_LOBES = {"roughness": 0.5, "metallic": 0.0, "specular": 0.5}
_LAYER_ROUGHNESS = {"clearcoat": 0.1, "sheen": 0.3}
# Linear gray where no base color is given.
_DEFAULT_COLOR = 0.5
# Default limit of the mesh cells across the tile.
DEFAULT_MESH = 512
# Attributes of a material that may be maps.
MAPS = (
    *("height", "base_color", "roughness", "metallic", "specular", "clearcoat", "clearcoat_roughness"),
    *("sheen", "sheen_color", "sheen_roughness", "normal", "opacity"),
)


@dataclass(frozen=True)
class Material:
    """Maps and constants of one tile, or its fibers or triangles, as
    :func:`~mbtf_gen.tile.loading.load_material` returns them.

    All maps have row 0 at ``v → 1``; their resolutions may differ.

    Attributes
    ----------
    height : (H, W) float64 array
        Stored heights: code / largest code of integer images, unchanged numbers of float images. Quantized
        heights are smoothed within half a level; heights of a mirrored tile are halved.
    height_scale : float
        Tile widths per stored height, from the material file (then `height_given` is True) or the default.
    height_bits : int or None
        8 or 16; None for floats.
    base_color, sheen_color : (h, w, 3) or (3,) array
        Linear Rec.709 in [0, 1]; `sheen_color` is None for white, or without a sheen.
    roughness, metallic, specular : (h, w) float64 array, float or None
        In [0, 1]; all three are None for a Lambert surface.
    clearcoat, clearcoat_roughness, sheen, sheen_roughness : (h, w) float64 array, float or None
        Weight and roughness of each layer in [0, 1]; None without it.
    normal : (h, w, 3) float32 array or None
        Unit vectors, x along u and y along v (OpenGL); None without a normal map.
    opacity : (h, w) float64 array, float or None
        In [0, 1]; None for an opaque material.
    bsdf : dict or None
        Mitsuba dictionary that replaces the reflectance maps.
    files, facts : dict of str to Path, dict of str to MapFacts
        File of each role, and its content.
    digests : dict of str to str
        SHA-256 of each role's file; ``settings`` covers all other inputs that change the data.
    warnings, notes : tuple of str
        Warnings that apply at any height scale, and remarks.
    unused : dict of str to str
        Reason why an image of the folder is not used, by file name.
    codes : Codes or None
        Distribution of integer height codes; None for floats.
    seams : tuple of Seam
        Seams of the heights before any tiling method.
    normal_fit : NormalFit or None
        Comparison of the normal map with the heights; None without a map, or where either is flat.
    normal_convention : {"gl", "dx"} or None
        Convention that the normal map was read in; None without a map.
    tile : {"none", "mirror", "blend"}
        Method that made the maps tileable.
    resolution : int or None
        Texels across at the finest level, from the material file; None without one there.
    shape : FiberTile, MeshTile or None
        Fibers or triangles in place of heights, which are a single 0 then; `bsdf` names their scattering.
    """

    height: NDArray[np.float64]
    height_scale: float
    height_bits: int | None
    base_color: Color
    roughness: Share = None
    metallic: Share = None
    specular: Share = None
    clearcoat: Share = None
    clearcoat_roughness: Share = None
    sheen: Share = None
    sheen_color: Color | None = None
    sheen_roughness: Share = None
    normal: NDArray[np.float32] | None = None
    opacity: Share = None
    bsdf: dict[str, Any] | None = None
    height_given: bool = False
    files: dict[str, Path] = field(default_factory=dict)
    digests: dict[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    unused: dict[str, str] = field(default_factory=dict)
    facts: dict[str, MapFacts] = field(default_factory=dict)
    codes: Codes | None = None
    seams: tuple[Seam, ...] = ()
    normal_fit: NormalFit | None = None
    normal_convention: Convention | None = None
    tile: Tiling = "none"
    resolution: int | None = None
    shape: FiberTile | MeshTile | None = None

    @property
    def aspect(self) -> float:
        """Height of the tile over its width, H/W of the maps."""
        return self.height.shape[0] / self.height.shape[1] if self.shape is None else self.shape.aspect

    @property
    def is_lambert(self) -> bool:
        """Is the surface Lambert because no roughness, metallic or specular is given?"""
        return self.bsdf is None and all(getattr(self, role) is None for role in _LOBES)

    def warnings_at(self, height: float | None = None) -> tuple[str, ...]:
        """Warnings at a height scale that the user gave; by default at the material's own."""
        if self.shape is not None:
            return self.warnings
        path, extent = self.files["height"], float(np.ptp(self.height))
        text = None
        if extent == 0:
            text = f"{path}: its heights are constant: the tile is flat"
        elif "normal" in self.files:
            factor = self.height_scale if height is None else height
            text = suggestion_warning(self.files["normal"], self.normal_fit, factor)
        extent *= abs(self.height_scale)
        if text is None and height is None and not self.height_given and extent > _STEEP:
            text = f"{path}: the displacement range is {extent:.4g} tile widths; check --height-scale"
        return self.warnings if text is None else (*self.warnings, text)

    def height_source(self, height: float | None = None) -> str:
        """Origin of the height scale in use, in words, where the user gave `height` or none."""
        return "given" if height is not None else "material file" if self.height_given else "default"

    def lattice(self, finest: int | None = None) -> Lattice:
        """Texel grids of the levels up to `finest`; by default up to the material's own resolution, else to
        that of the map."""
        if finest is None and self.resolution is not None:
            finest = self.resolution.bit_length() - 1
        if self.shape is not None and finest is not None:
            return Lattice(finest, self.aspect)
        rows, columns = self.height.shape
        return Lattice.for_map(rows, columns, finest)

    def grid(self, height: float | None = None, mesh: int | None = None) -> HeightGrid:
        """Resample the heights to the grid of the mesh.

        Parameters
        ----------
        height : float or None
            Tile widths per stored height; `height_scale` by default.
        mesh : int or None
            Cells across the tile; by default the width of the map, at most 512. Coarser grids average the
            map (box filter), finer grids interpolate it (cubic).

        Returns
        -------
        HeightGrid
        """
        columns = min(self.height.shape[1], DEFAULT_MESH) if mesh is None else mesh
        rows = max(1, round(self.aspect * columns))
        heights = resample(self.height, rows, columns, "cubic")
        return HeightGrid.from_map(
            heights.astype(np.float64), self.height_scale if height is None else height, self.aspect
        )


def layers_above(given: Container[str]) -> str:
    """``" under a clear coat and a sheen"``, as far as they are among the given roles."""
    texts = [text for role, text in (("clearcoat", "a clear coat"), ("sheen", "a sheen")) if role in given]
    return f" under {' and '.join(texts)}" if texts else ""


def assemble(spec: MaterialFile, folder: Path, found: FoundMaps, tile: Tiling) -> Material:
    """The material of a material file and the maps found in a folder."""
    load = MapLoader(folder, found.notes)
    load.warnings += found.warnings
    height, codes, scale = _heights(spec, load)
    rounding = 0.0 if codes is None else codes.rounding / (2 ** (load.facts["height"].bits or 8) - 1)
    edges = seams(height, rounding)
    warning = seam_warning(load.files["height"], edges, scale)
    if warning is not None and tile == "none":
        load.warnings.append(warning)
    maps: dict[str, Any] = {role: load.share(role, getattr(spec, role)) for role in _LOBES}
    if spec.bsdf is not None:
        load.notes.append(f"surface: the BSDF '{spec.bsdf['type']}' of the material file")
    elif all(value is None for value in maps.values()):
        under = layers_above({layer for layer in _LAYER_ROUGHNESS if getattr(spec, layer) is not None})
        load.notes.append(f"surface: Lambert{under}, because no roughness, metallic or specular is given")
    else:
        constants = {role: value for role, value in _LOBES.items() if maps[role] is None}
        maps |= constants
        filled = ", ".join(f"{role} {value}" for role, value in constants.items())
        load.notes.append(f"surface: glossy{'; default ' + filled if filled else ''}")
    maps["base_color"] = np.full(3, _DEFAULT_COLOR)
    if spec.base_color is not None:
        maps["base_color"] = load.color("base_color", spec.base_color)
    elif spec.bsdf is None:
        load.notes.append(f"base color: {_DEFAULT_COLOR} gray, none is given")
    convention, fit = None, None
    if spec.normal is not None:
        maps["normal"], convention, fit = _normals(spec.normal, load, height)
    maps["opacity"] = load.share("opacity", spec.opacity)
    if maps["opacity"] is not None:
        holes = np.mean(np.asarray(maps["opacity"]) < 0.5)
        load.notes.append(f"opacity: {holes:.0%} of the tile are holes")
    for layer, roughness in _LAYER_ROUGHNESS.items():
        maps[layer] = load.share(layer, getattr(spec, layer))
        own = load.share(f"{layer}_roughness", getattr(spec, f"{layer}_roughness"))
        maps[f"{layer}_roughness"] = roughness if maps[layer] is not None and own is None else own
    if spec.sheen_color is not None:
        maps["sheen_color"] = load.color("sheen_color", spec.sheen_color)
    if spec.bsdf is not None:
        maps["bsdf"], load.settings["bsdf"] = _bsdf(spec.bsdf, load)
    load.settings |= {} if tile == "none" else {"tile": tile}
    load.settings |= {} if spec.resolution is None else {"resolution": spec.resolution}
    digests = {role: file_sha256(path) for role, path in load.files.items()}
    digests["settings"] = data_sha256(load.settings)
    return Material(
        height=height,
        height_scale=scale,
        height_bits=load.facts["height"].bits,
        **maps,
        height_given=spec.height.scale is not None,
        files=load.files,
        digests=digests,
        warnings=tuple(load.warnings),
        notes=tuple(load.notes),
        unused=found.unused,
        facts=load.facts,
        codes=codes,
        seams=edges,
        normal_fit=fit,
        normal_convention=convention,
        resolution=spec.resolution,
    )


def retiled(material: Material, tile: Literal["mirror", "blend"]) -> Material:
    """The material with all its maps mirrored or blended."""
    folder = material.files["height"].parent
    if any(role.startswith("bsdf.") for role in material.files):
        raise InputError(
            "the textures of its bsdf cannot be mirrored or blended",
            where=folder,
            hint="use --make-tileable none, or give maps in place of the bsdf",
        )
    if tile == "mirror" and any(4 * f.rows * f.columns > MAX_PIXELS for f in material.facts.values()):
        raise InputError(
            f"mirrored maps would have more than {MAX_PIXELS:,} pixels",
            where=folder,
            hint="use smaller maps, or --make-tileable blend",
        )
    note = f"tile: edges blended over {BAND:g} of the tile"
    if tile == "mirror":
        note = "tile: 2 x 2 mirrored copies, two images wide, so heights in tile widths are halved"
    maps = retile({name: getattr(material, name) for name in MAPS}, tile)
    return replace(material, **maps, notes=(*material.notes, note), tile=tile)


def _normals(
    entry: NormalEntry, load: MapLoader, height: NDArray[np.float64]
) -> tuple[NDArray[np.float32], Convention, NormalFit | None]:
    """Unit vectors (h, w, 3), their convention, and their comparison with the heights."""
    vectors = load.normals(entry)
    path = load.files["normal"]
    fit = fit_normals(height, vectors)
    convention, how, warning = choose_convention(fit, normal_convention(path.name), entry.convention, path)
    misfit = None if fit is None else orientation_warning(fit, path, load.files["height"])
    load.warnings += filter(None, (warning, misfit))
    load.notes.append(normal_note(path, fit, convention, how))
    load.settings["normal"] = convention
    green = np.array([1.0, 1.0 if convention == "gl" else -1.0, 1.0], np.float32)
    return vectors * green, convention, fit


def _heights(spec: MaterialFile, load: MapLoader) -> tuple[NDArray[np.float64], Codes | None, float]:
    """Stored heights, their codes, and the factor to tile widths."""
    entry = spec.height
    image = load.image("height", entry, entry.colorspace)
    refuse_color(image)
    height, warnings = gray(image)
    load.warnings += warnings
    largest = float(np.abs(height).max())
    if largest > _MOST:
        raise InputError(f"stores heights up to {largest:.4g}; at most {_MOST:g} are read", where=image.path)
    default = _FLOAT_SCALE if image.bits is None else _INTEGER_SCALE
    scale = default if entry.scale is None else entry.scale
    codes, step = None, None
    if image.bits is not None:
        white = 2**image.bits - 1
        codes = code_use(np.rint(height * white))
        step = coarse_step(codes, image.bits)
        if step is not None and codes.levels > 1:
            load.warnings.append(level_warning(image.path, codes, image.bits, step, entry.dequantize))
            if entry.dequantize:
                height = dequantize(height, step / white)
    load.settings["height"] = [scale, step if entry.dequantize else None]
    if entry.colorspace == "srgb":
        height = np.asarray(srgb_to_linear(height), np.float64)
        load.settings["height.encoding"] = entry.colorspace
    kind = "floats" if image.bits is None else f"{image.bits}-bit integers"
    load.notes.append(f"heights: {image.path.name}, {image.shape[1]} x {image.shape[0]} {kind}")
    return height, codes, scale


def _bsdf(tree: dict[str, Any], load: MapLoader) -> tuple[dict[str, Any], dict[str, Any]]:
    """The BSDF with its file names made absolute, and the same with digests in place of file names."""

    def refuse(value: Any) -> None:
        kind = type(value).__name__
        raise InputError(f"the bsdf holds a {kind}, not text or a number", where=load.folder)

    def resolved(node: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        out: dict[str, Any] = {}
        nameless: dict[str, Any] = {}
        for key, value in node.items():
            if isinstance(value, dict):
                out[key], nameless[key] = resolved(value)
            elif key == "filename" and isinstance(value, str):
                path = _bsdf_file(value, load)
                out[key], nameless[key] = str(path), file_sha256(path)
            else:
                out[key] = nameless[key] = value
        return out, nameless

    # The same data in Python's own types, without what a YAML reader attaches.
    return resolved(json.loads(json.dumps(tree, default=refuse)))


def _bsdf_file(name: str, load: MapLoader) -> Path:
    try:
        path = (load.folder / name).resolve()
        found = path.is_file()
    except (OSError, ValueError):
        raise InputError("the bsdf names a file whose name is not valid", where=load.folder) from None
    if not found:
        raise InputError("no such file (named in the bsdf)", where=path, hint=suggest_path(path))
    load.files[f"bsdf.{sum(role.startswith('bsdf.') for role in load.files)}"] = path
    return path
