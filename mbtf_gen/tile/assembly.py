"""Material file and maps → the height-field tile that they describe."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mbtf_core.color import srgb_to_linear
from mbtf_core.data.schema import Tiling
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import data_sha256, file_sha256
from mbtf_core.images.read import count_and_first, gray
from mbtf_core.images.resample import dequantize
from mbtf_core.paths import named_file, real_path, suggest_path
from mbtf_gen.tile.heightfield_tile import MAPS, HeightFieldTile
from mbtf_gen.tile.maps.checks import (
    Codes,
    choose_convention,
    coarse_step,
    code_use,
    inversion_warning,
    level_warning,
    normal_note,
    refuse_color,
    seam_warning,
)
from mbtf_gen.tile.maps.discovery import FoundMaps
from mbtf_gen.tile.maps.file_names import Convention, normal_convention
from mbtf_gen.tile.maps.map_loader import FILL, MapLoader
from mbtf_gen.tile.maps.material_file import LOBES, ROLES, MaterialFile, NormalEntry, layers_above
from mbtf_gen.tile.maps.normal_map import NormalFit, fit_normals
from mbtf_gen.tile.maps.tiling import BAND, retile, seams

# Tile widths per stored height: the range of integer images is unknown, floats are in tile widths.
_INTEGER_SCALE, _FLOAT_SCALE = 0.05, 1.0
# Largest stored height; squares of larger ones are beyond float32.
_MOST = 1e15
# Pixels of quantized heights that are smoothed whatever their file's size, and those of each byte.
_SMOOTHED, _SMOOTHED_PER_BYTE = 1 << 24, 64
# Linear gray where no base color is given.
_DEFAULT_COLOR = 0.5


def assemble(
    spec: MaterialFile, folder: Path, found: FoundMaps, tile: Tiling, max_pixels: int
) -> HeightFieldTile:
    """The tile of a material file and the maps found in a folder, of at most `max_pixels` pixels each."""
    load = MapLoader(folder, found.notes, max_pixels)
    load.warnings += found.warnings
    height, codes, scale = _heights(spec, load)
    rounding = 0.0 if codes is None else codes.rounding / (2 ** (load.facts["height"].bits or 8) - 1)
    edges = seams(height, rounding)
    warning = seam_warning(load.files["height"], edges, scale)
    if warning is not None and tile == "none":
        load.warnings.append(warning)
    maps: dict[str, Any] = {role: load.share(role, getattr(spec, role)) for role in LOBES}
    layers = {role.effect for name, role in ROLES.items() if role.layer and getattr(spec, name) is not None}
    if spec.bsdf is not None:
        load.notes.append(f"surface: the BSDF '{spec.bsdf['type']}' of the material file")
    elif all(value is None for value in maps.values()):
        under = layers_above(layers)
        load.notes.append(f"surface: Lambert{under}, because no roughness, metallic or specular is given")
    else:
        constants = {role: value for role, value in LOBES.items() if maps[role] is None}
        maps |= constants
        filled = ", ".join(f"{role} {value}" for role, value in constants.items())
        load.notes.append(f"surface: glossy{'; default ' + filled if filled else ''}")
    maps["base_color"] = np.full(3, _DEFAULT_COLOR)
    if spec.base_color is not None:
        maps["base_color"] = load.color("base_color", spec.base_color, spec.opacity)
    elif spec.bsdf is None:
        load.notes.append(f"base color: {_DEFAULT_COLOR} gray, none is given")
    convention, fit = None, None
    if spec.normal is not None:
        maps["normal"], convention, fit = _normals(spec.normal, load, height)
    maps["opacity"] = load.share("opacity", spec.opacity)
    if maps["opacity"] is not None:
        holes = np.mean(np.asarray(maps["opacity"]) < 0.5)
        load.notes.append(f"opacity: {holes:.0%} of the tile are holes")
    for name, role in ROLES.items():
        if role.effect in layers:
            entry = getattr(spec, name)
            if name.endswith("color"):
                maps[name] = None if entry is None else load.color(name, entry)
            else:
                maps[name] = role.default if entry is None else load.share(name, entry)
    bsdf = None
    if spec.bsdf is not None:
        bsdf, load.settings["bsdf"] = _bsdf(spec.bsdf, load)
    load.settings |= {} if tile == "none" else {"tile": tile}
    load.settings |= {} if spec.resolution is None else {"resolution": spec.resolution}
    digests = {role: file_sha256(path) for role, path in load.files.items()}
    digests["settings"] = data_sha256(load.settings)
    return HeightFieldTile(
        height=height,
        maps={role: maps[role] for role in ROLES if maps.get(role) is not None},
        bsdf=bsdf,
        height_scale=scale,
        height_from="default" if spec.height.scale is None else "material file",
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


def retiled(material: HeightFieldTile, tile: Literal["mirror", "blend"], max_pixels: int) -> HeightFieldTile:
    """The tile with all its maps mirrored or blended, of at most `max_pixels` pixels each."""
    folder = material.files["height"].parent
    if any(role.startswith("bsdf.") for role in material.files):
        raise InputError(
            "the textures of its bsdf cannot be mirrored or blended",
            where=folder,
            hint="use --make-tileable none, or give maps in place of the bsdf",
        )
    if tile == "mirror" and any(4 * f.rows * f.columns > max_pixels for f in material.facts.values()):
        raise InputError(
            f"mirrored maps would have more than {max_pixels:,} pixels",
            where=folder,
            hint="use smaller maps, --make-tileable blend, or a larger geometry.max_pixels",
        )
    note = f"tile: edges blended over {BAND:g} of the tile"
    if tile == "mirror":
        note = "tile: 2 x 2 mirrored copies, two images wide, so heights in tile widths are halved"
    given = {"height": material.height, **material.maps}
    maps = retile({name: given[name] for name in MAPS if name in given}, tile)
    height = maps.pop("height")
    return replace(material, height=height, maps=maps, notes=(*material.notes, note), tiling=tile)


def _normals(
    entry: NormalEntry, load: MapLoader, height: NDArray[np.float64]
) -> tuple[NDArray[np.float32], Convention, NormalFit | None]:
    """Unit vectors (h, w, 3), their convention, and their comparison with the heights."""
    vectors = load.normals(entry)
    path = load.files["normal"]
    fit = fit_normals(height, vectors)
    convention, how, warning = choose_convention(fit, normal_convention(path.name), entry.convention, path)
    load.warnings += filter(None, (warning, inversion_warning(fit, path)))
    load.notes.append(normal_note(path, fit, convention, how))
    load.settings["normal"] = convention
    green = np.array([1.0, 1.0 if convention == "gl" else -1.0, 1.0], np.float32)
    return vectors * green, convention, fit


def _heights(spec: MaterialFile, load: MapLoader) -> tuple[NDArray[np.float64], Codes | None, float]:
    """Stored heights, their codes, and the factor to tile widths."""
    entry = spec.height
    image = load.image("height", entry, entry.colorspace)
    refuse_color(image, "height")
    height, warnings = gray(image)
    load.warnings += warnings
    if max(-float(height.min()), float(height.max())) > _MOST:
        far = np.abs(height) > _MOST
        what = f"{count_and_first(far)} beyond {_MOST:g}, as where data are missing"
        raise InputError(what, where=image.path, hint=FILL)
    default = _FLOAT_SCALE if image.bits is None else _INTEGER_SCALE
    scale = default if entry.scale is None else entry.scale
    codes, step = None, None
    if image.bits is not None:
        white = 2**image.bits - 1
        codes = code_use(image.stored[..., 0] if image.stored.shape[2] < 3 else np.rint(height * white))
        step = coarse_step(codes, image.bits)
        if step is not None and codes.levels > 1:
            load.warnings.append(level_warning(image.path, codes, image.bits, step, entry.dequantize))
            if entry.dequantize:
                _check_smoothed(height.size, image.path)
                height = dequantize(height, step / white)
    load.settings["height"] = [scale, step if entry.dequantize else None]
    if entry.colorspace == "srgb":
        height = np.asarray(srgb_to_linear(height), np.float64)
        load.settings["height.encoding"] = entry.colorspace
    kind = "floats" if image.bits is None else f"{image.bits}-bit integers"
    load.notes.append(f"heights: {image.path.name}, {image.shape[1]} x {image.shape[0]} {kind}")
    return height, codes, scale


def _check_smoothed(pixels: int, path: Path) -> None:
    """Refuse a large map of a small file, whose smoothing takes gigabytes: 60 bytes per pixel."""
    size = path.stat().st_size
    if pixels > max(_SMOOTHED, _SMOOTHED_PER_BYTE * size):
        raise InputError(
            f"has {pixels:,} pixels in {size:,} bytes, almost all of which are alike",
            where=path,
            hint=f"reduce it, or write height: {{file: {path.name}, dequantize: false}}",
        )


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
        path = real_path(named_file(load.folder, name))
        found = path.is_file()
    except (OSError, ValueError):
        raise InputError("the bsdf names a file whose name is not valid", where=load.folder) from None
    if not found:
        raise InputError("no such file (named in the bsdf)", where=path, hint=suggest_path(path))
    load.files[f"bsdf.{sum(role.startswith('bsdf.') for role in load.files)}"] = path
    return path
