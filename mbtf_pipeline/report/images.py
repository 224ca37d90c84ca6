"""Images of the report: scenes of the viewer, the sheet of references, fits and error maps, and offsets.

Images, maps and color bars of all pages are made here, as ``data:`` URIs.
"""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from mbtf_core.color import (
    Palette,
    indices,
    palette,
    robust_scale,
    tick_labels,
    to_display,
    white_of,
)
from mbtf_core.stats import local_error
from mbtf_core.units import tiles_text
from mbtf_pipeline.compare.image_files import read_halves, read_map, read_picture
from mbtf_pipeline.compare.offsets import read_offset, towards_view
from mbtf_pipeline.compare.perceptual_metrics import available_metrics
from mbtf_pipeline.recipe import SceneView
from mbtf_pipeline.stages import COMPARE
from mbtf_pipeline.tables import (
    decibel,
    direction,
    estimate,
    estimate_text,
    levels_text,
    short_direction,
    signed,
)

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]
Pixels = NDArray[np.floating]
# URIs of a page's images by name.
Gallery = dict[str, str]
_JPEG_QUALITY = 86


def color_bar(
    key: Palette, title: str, high: float, unit: str, factor: float = 1.0, *, clipped: bool = False
) -> dict[str, Any]:
    """A labeled color bar with five evenly spaced numbers up to `high`, which `factor` converts to `unit`;
    where values are `clipped`, its ends say so."""
    low = -high if key == "signed" else 0.0
    colors = palette(key)[np.linspace(0, 255, 17).round().astype(int)].tolist()
    ticks = tick_labels(low, high, factor)
    if clipped:
        ticks[-1] = f"≥ {ticks[-1]}"
        ticks[0] = f"≤ {ticks[0]}" if low else ticks[0]
    return {
        "key": key,
        "title": title,
        "gradient": f"linear-gradient(90deg, {', '.join('rgb({} {} {})'.format(*c) for c in colors)})",
        "ticks": ticks,
        "unit": unit,
    }


def data_uri(display: U8, kind: Literal["png", "jpeg"] = "png", colors: Palette | None = None) -> str:
    """``data:`` URI of an 8-bit sRGB or gray image, or of indices into a palette."""
    from PIL import Image

    image = Image.fromarray(display)
    if colors is not None:
        image.putpalette(palette(colors).tobytes())
    stream = io.BytesIO()
    options = {"quality": _JPEG_QUALITY, "subsampling": 0} if kind == "jpeg" else {}
    image.save(stream, kind, optimize=True, **options)
    return f"data:image/{kind};base64,{base64.b64encode(stream.getvalue()).decode()}"


def map_uri(values: Pixels, name: Palette) -> str:
    """``data:`` URI of a map (rows, columns) as PNG in the colors of a palette."""
    return data_uri(indices(values, name), colors=name)


def file_uri(path: Path, most: int | None = None) -> str:
    """``data:`` URI of an image file as JPEG, shrunk to so many pixels along a side at most; an OSError where
    it is missing or corrupt."""
    from PIL import Image

    with Image.open(path) as image:
        small = image.convert("RGB")
    if most is not None:
        small.thumbnail((most, most))
    return data_uri(np.asarray(small), "jpeg")


_KIND = {"query": "Reference", "pixel": "Reference, filtered pixel"}
# Share of a map's pixels beyond the scale from which it is marked.
_CLIPPED = 0.05
# Error maps: title, unit, and factor to that unit.
_MAPS: dict[Palette, tuple[str, str, float]] = {
    "local": ("Local RMS error", "% of white", 100.0),
    "flip": ("HDR-FLIP", "from 0 to 1", 1.0),
    "signed": ("Fit − reference", "% of white", 100.0),
}


def picture_section(
    folder: Path, comparison: Mapping[str, Any], exposure: float, gallery: Gallery
) -> dict[str, Any]:
    """Lay out all images of a comparison in its folder, which `gallery` receives. Errors are shown as
    fractions of the white of the exposure in EV.

    Returns
    -------
    groups : per view and light: title, places in the hemisphere, blocks of figures
    scenes : of the viewer, plain data
    color_bars : of local error, HDR-FLIP and signed difference
    """
    white = white_of(exposure)
    groups: list[dict[str, Any]] = []
    scenes = []
    # By map and fit, then by file.
    maps: dict[Palette, dict[str, dict[str, Pixels]]] = {
        name: {fit: {} for fit in comparison["fits"]} for name in _MAPS
    }
    for number, picture in enumerate(comparison["pictures"]):
        references = [picture["references"][kind]["file"] for kind in comparison["kinds"]]
        fits = [picture["fits"][fit]["file"] for fit in comparison["fits"]]
        pictures = {file: read_picture(folder / file) for file in (*references, *fits)}
        gallery |= {file: data_uri(to_display(value, exposure)) for file, value in pictures.items()}
        a, b = read_halves(folder / references[0])
        mean = 0.5 * (a.astype(np.float64) + b)
        for fit, file in zip(comparison["fits"], fits, strict=True):
            maps["local"][fit][file] = local_error(pictures[file], a, b) / white
            maps["flip"][fit][file] = read_map(folder / file)
            maps["signed"][fit][file] = (pictures[file] - mean).mean(axis=-1) / white
        key = (picture["view"], picture["light"])
        if not groups or groups[-1]["key"] != key:
            # Places in the unit disk: cosine of the elevation, and azimuth.
            places = [(math.cos(math.radians(d["elevation"])), d["azimuth"]) for d in key]
            group = {"key": key, "places": places, "blocks": []}
            group["title"] = f"View {direction(key[0])}  ·  light {direction(key[1])}"
            group["short"] = [f"view {short_direction(key[0])}", f"light {short_direction(key[1])}"]
            groups.append(group)
        groups[-1]["blocks"].append(_block(comparison, picture, number))
        scenes.append({"group": len(groups) - 1, **_scene(comparison, picture)})
    bars, images, beyond = scaled_maps(maps)
    gallery |= images
    blocks = (block for group in groups for block in group["blocks"])
    for cell in (c for block in blocks for row in block["maps"].values() for c in row):
        if (share := beyond.get(cell["image"])) is not None:
            cell["lines"].append(f"{share:.0%} of the pixels exceed the scale")
    return {"groups": groups, "scenes": scenes, "color_bars": bars}


def scaled_maps(
    maps: Mapping[Palette, Mapping[str, Mapping[str, Pixels]]],
) -> tuple[dict[str, Any], Gallery, dict[str, float]]:
    """Error maps by kind, fit and file on common scales, which a diverged fit does not widen: the color bar
    of each kind, images by name, and the share of pixels beyond the scale of those with more than a few."""
    bars: dict[str, Any] = {}
    images: Gallery = {}
    beyond: dict[str, float] = {}
    for kind, by_fit in maps.items():
        scale = robust_scale([list(found.values()) for found in by_fit.values()])
        scale = min(scale, 1.0) if kind == "flip" else scale
        found = {f"{file}-{kind}": values for files in by_fit.values() for file, values in files.items()}
        shares = {image: float(np.mean(np.abs(values) > scale)) for image, values in found.items()}
        clipped = {image: share for image, share in shares.items() if share > _CLIPPED}
        title, unit, factor = _MAPS[kind]
        bars[kind] = color_bar(kind, title, scale, unit, factor, clipped=bool(clipped))
        images |= {image: map_uri(values / scale, kind) for image, values in found.items()}
        beyond |= clipped
    return bars, images, beyond


def _title(comparison: Mapping[str, Any], picture: Mapping[str, Any]) -> str:
    levels = levels_text(picture["levels"], comparison["finest"])
    return f"{tiles_text(picture['tiles_across'])} across, {levels}"


def _block(comparison: Mapping[str, Any], picture: Mapping[str, Any], number: int) -> dict[str, Any]:
    """Figures of one scene: references and fits, side by side; below each fit, its error maps."""
    where = f": view {direction(picture['view'])}, light {direction(picture['light'])}, "
    where += f"{tiles_text(picture['tiles_across'])} across"
    references, fits, kinds = [], [], comparison["kinds"]
    for kind in kinds:
        reference = picture["references"][kind]
        lines = [f"noise per pixel {100 * estimate(reference['noise']).value:.1f}%"]
        if kind != kinds[0]:
            other = estimate_text(estimate(picture["between_references"]), 1e3)
            lines.append(f"MSE to the other reference {other} · 10⁻³/sr²")
        references.append(_figure(reference["file"], _KIND[kind], lines, where, exr=True))
    maps: dict[Palette, list[dict[str, Any]]] = {"local": [], "flip": []}
    for fit in comparison["fits"]:
        record = picture["fits"][fit]
        file, errors = record["file"], record["errors"][kinds[0]]
        mse = estimate(errors["mse"])
        psnr = f"PSNR {decibel(estimate(errors['psnr']), mse)}"
        fits.append(_figure(file, fit, [psnr], where, exr=True))
        numbers: dict[Palette, str] = {
            "local": f"MSE {estimate_text(mse, 1e3)} · 10⁻³/sr²",
            "flip": f"mean {record['flip']['hdr']:.3f}",
        }
        for kind, line in numbers.items():
            # Of several fits, the head of the row names the map.
            label = fit if len(comparison["fits"]) > 1 else _MAPS[kind][0]
            cell = _figure(f"{file}-{kind}", label, [line], where)
            maps[kind].append(cell | {"alt": f"{_MAPS[kind][0]} of {fit}{where}"})
    # The main reference stands beside the fits.
    title = _title(comparison, picture)
    return {"title": title, "references": references[::-1], "fits": fits, "maps": maps, "scene": number}


def _scene(comparison: Mapping[str, Any], picture: Mapping[str, Any]) -> dict[str, Any]:
    """Data of a scene for the viewer."""
    where = f"View {direction(picture['view'])}; light {direction(picture['light'])}; "
    references = [
        {
            "label": _KIND[kind],
            "picture": picture["references"][kind]["file"],
            "rows": _numbers(comparison, picture, kind),
        }
        for kind in comparison["kinds"]
    ]
    return {
        "where": where + _title(comparison, picture),
        "tiles_across": f"{tiles_text(picture['tiles_across'])} across",
        "references": references,
        "fits": [picture["fits"][fit]["file"] for fit in comparison["fits"]],
    }


def _numbers(comparison: Mapping[str, Any], picture: Mapping[str, Any], kind: str) -> list[list[str]]:
    """Errors of a scene: name of the metric, then one cell per fit."""
    records = [picture["fits"][fit] for fit in comparison["fits"]]
    errors = [{name: estimate(e) for name, e in record["errors"][kind].items()} for record in records]
    rows = [
        ["MSE [10⁻³/sr²]", *(estimate_text(e["mse"], 1e3) for e in errors)],
        ["relative MSE", *(estimate_text(e["relative_mse"]) for e in errors)],
        ["PSNR", *(decibel(e["psnr"], e["mse"]) for e in errors)],
    ]
    if kind == comparison["kinds"][0]:
        noise = picture["references"][kind]
        metrics = available_metrics(comparison["pictures"], comparison["fits"])
        rows += [[m.title, *(m.text(m.of(r), m.of(noise)) for r in records)] for m in metrics]
        if len(records) > 1:
            cells = (estimate_text(estimate(r["mse_minus_first"]), 1e3) for r in records[1:])
            rows.append([f"MSE − MSE of {comparison['fits'][0]} [10⁻³/sr²]", "–", *cells])
    return rows


def offset_section(folder: Path, records: list[dict[str, Any]], gallery: Gallery) -> list[dict[str, Any]]:
    """Rows of offset images: traced, then learned by each fit, each with its own color scale."""
    fits = (None, *records[0]["fits"]) if records else ()
    return [_offset_row(folder, records, fit, gallery) for fit in fits]


def _offset_file(record: Mapping[str, Any], fit: str | None) -> str:
    return str(record["traced"] if fit is None else record["fits"][fit]["file"])


def _offset_row(
    folder: Path, records: list[dict[str, Any]], fit: str | None, gallery: Gallery
) -> dict[str, Any]:
    """Displacements towards the viewer, traced (`fit` is None) or learned, minus their median."""
    title = "Traced through the heights" if fit is None else f"Offset of {fit}"
    whole = [
        towards_view(read_offset(folder / _offset_file(r, fit)), SceneView(**r["view"])) for r in records
    ]
    medians = [float(np.median(m)) for m in whole]
    maps: list[Pixels] = [m - median for m, median in zip(whole, medians, strict=True)]
    scale, cells = robust_scale([maps]), []
    for number, (record, values, median) in enumerate(zip(records, maps, medians, strict=True)):
        name = f"offset-{fit or 'traced'}-{number}"
        gallery[name] = map_uri(values / scale, "signed")
        view = f"view {direction(record['view'])}"
        lines = [view, signed(f"median {median:.2g} tile widths")]
        if fit is not None and (found := record["fits"][fit]["correlation"]) is not None:
            lines.append(signed(f"correlation with the traced offset {found:.2f}"))
        cell = _figure(name, title, lines, f", {view}")
        cells.append(cell | {"file": _exr_link(_offset_file(record, fit))})
    return {"cells": cells, "bar": color_bar("signed", "Displacement", scale, "tile widths")}


def _figure(image: str, label: str, lines: list[str], where: str, *, exr: bool = False) -> dict[str, Any]:
    figure = {"image": image, "label": label, "lines": lines, "alt": f"{label}{where}"}
    return figure | {"file": _exr_link(image) if exr else ""}


def _exr_link(file: str) -> str:
    """Address, relative to the report, of an EXR file of the comparison."""
    return quote(f"{COMPARE}/{file.removesuffix('.exr')}.exr")
