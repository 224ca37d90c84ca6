"""Images of the report: scenes of the viewer, and the sheet of references, fits and error maps."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from mbtf_pipeline.compare.image_files import read_halves, read_map, read_picture
from mbtf_pipeline.compare.perceptual_metrics import available_metrics
from mbtf_pipeline.report.embed import Gallery, Pixels
from mbtf_pipeline.report.error_maps import color_bar, common_scale, local_error
from mbtf_pipeline.run_folder import COMPARE
from mbtf_pipeline.tables import (
    decibel,
    direction,
    estimate,
    estimate_text,
    levels_text,
    short_direction,
    width,
)

_KIND = {"query": "Reference", "pixel": "Reference, filtered pixel"}


def hemisphere(view: Mapping[str, float], light: Mapping[str, float]) -> str:
    """The hemisphere from above with the view (square) and the light (disk), as an ``<svg>`` element."""

    def position(d: Mapping[str, float]) -> tuple[float, float]:
        r = 20.0 * math.cos(math.radians(d["elevation"]))
        a = math.radians(d["azimuth"])
        return r * math.cos(a), -r * math.sin(a)

    (vx, vy), (lx, ly) = position(view), position(light)
    return (
        '<svg viewBox="-24 -24 48 48" aria-hidden="true">'
        '<g fill="none" stroke="currentColor" opacity=".35"><circle r="20"/><circle r="10"/>'
        '<path d="M-20 0H20M0-20V20" stroke-width=".6"/></g>'
        f'<rect x="{vx - 3.4:.2f}" y="{vy - 3.4:.2f}" width="6.8" height="6.8" rx="1" fill="var(--accent)"/>'
        f'<circle cx="{lx:.2f}" cy="{ly:.2f}" r="3.9" fill="#e69f00"/></svg>'
    )


def picture_section(folder: Path, comparison: Mapping[str, Any], gallery: Gallery) -> dict[str, Any]:
    """Lay out all images of a comparison.

    Parameters
    ----------
    folder : of the comparison
    gallery : receives the images; errors are shown as fractions of its white

    Returns
    -------
    groups : per view and light: title, diagram, blocks of figures
    scenes : of the viewer, plain data
    color_bars : of local error, HDR-FLIP and signed difference
    """
    sheet = _Sheet(comparison)
    groups: list[dict[str, Any]] = []
    scenes = []
    maps: dict[str, tuple[Pixels, Pixels, Pixels]] = {}
    for number, picture in enumerate(comparison["pictures"]):
        references = [picture["references"][kind]["file"] for kind in sheet.kinds]
        fits = [picture["fits"][fit]["file"] for fit in sheet.fits]
        gallery.linear |= {file: read_picture(folder / file) for file in (*references, *fits)}
        a, b = read_halves(folder / references[0])
        for file in fits:
            value = gallery.linear[file]
            signed = (value.astype(np.float64) - 0.5 * (a.astype(np.float64) + b)).mean(axis=-1)
            maps[file] = (
                local_error(value, a, b) / gallery.white,
                read_map(folder / file),
                signed / gallery.white,
            )
        key = (picture["view"], picture["light"])
        if not groups or groups[-1]["key"] != key:
            groups.append(
                {
                    "key": key,
                    "title": f"View {direction(key[0])}  ·  light {direction(key[1])}",
                    "diagram": hemisphere(*key),
                    "short": [f"view {short_direction(key[0])}", f"light {short_direction(key[1])}"],
                    "blocks": [],
                }
            )
        groups[-1]["blocks"].append(sheet.block(number, picture))
        scenes.append({"group": len(groups) - 1, **sheet.scene(picture)})
    local, flip, signed_end = (common_scale([e[i] for e in maps.values()]) for i in range(3))
    flip = min(flip, 1.0)
    for file, (error, visible, signed) in maps.items():
        gallery.maps[f"{file}-local"] = "local", error / local
        gallery.maps[f"{file}-flip"] = "flip", visible / flip
        gallery.maps[f"{file}-signed"] = "signed", signed / signed_end
    color_bars = (
        color_bar(
            "local",
            "Local RMS error",
            local,
            "% of white",
            "Noise-free: root of (p−a)(p−b), averaged over channels and a Gaussian window with σ = 2 pixels. "
            "0 where the average is negative, because the error lies below the noise.",
            100,
        ),
        color_bar(
            "flip",
            "HDR-FLIP",
            flip,
            "from 0 to 1",
            "Visible difference: maximum over −2, 0 and +2 stops. Includes the noise of the reference.",
        ),
        color_bar(
            "signed",
            "Fit − reference",
            signed_end,
            "% of white",
            "Mean of the channels. Blue is too dark, orange too bright. Includes the noise of the reference.",
            100,
        ),
    )
    bars = {bar["key"]: bar for bar in color_bars}
    return {"groups": groups, "scenes": scenes, "color_bars": bars}


class _Sheet:
    """Figures of the sheet and scenes of the viewer."""

    def __init__(self, comparison: Mapping[str, Any]) -> None:
        self.fits, self.kinds = comparison["fits"], comparison["kinds"]
        self._finest = comparison["finest"]
        self._metrics = available_metrics(comparison["pictures"], comparison["fits"])

    def _title(self, picture: Mapping[str, Any]) -> str:
        return f"{width(picture['tiles_across'])}, {levels_text(picture['levels'], self._finest)}"

    def block(self, number: int, picture: Mapping[str, Any]) -> dict[str, Any]:
        """Figures of one scene: rows of four, references in the first column."""
        where = f"view {direction(picture['view'])}, light {direction(picture['light'])}, "
        where += width(picture["tiles_across"])
        rows: list[list[dict[str, Any] | None]] = []
        for index in range(max(len(self.kinds), len(self.fits))):
            row: list[dict[str, Any] | None] = [None]
            if index < len(self.kinds):
                row = [self._reference(picture, self.kinds[index], where)]
            if index < len(self.fits):
                row += self._fit(picture, self.fits[index], where)
            rows.append(row)
        return {"title": self._title(picture), "rows": rows, "scene": number}

    def _reference(self, picture: Mapping[str, Any], kind: str, where: str) -> dict[str, Any]:
        reference = picture["references"][kind]
        lines = [f"noise per pixel {100 * estimate(reference['noise']).value:.1f} %"]
        if kind != self.kinds[0]:
            mse = estimate_text(estimate(picture["between_references"]), 1e3)
            lines.append(f"MSE to the other reference {mse} · 10⁻³/sr²")
        return _figure(reference["file"], _KIND[kind], lines, f": {where}", exr=True)

    def _fit(self, picture: Mapping[str, Any], fit: str, where: str) -> list[dict[str, Any]]:
        record = picture["fits"][fit]
        file, errors = record["file"], record["errors"][self.kinds[0]]
        mse = estimate(errors["mse"])
        of_fit = f" of {fit}: {where}"
        psnr = [f"PSNR {decibel(estimate(errors['psnr']), mse)}"]
        local = [f"MSE {estimate_text(mse, 1e3)} · 10⁻³/sr²"]
        return [
            _figure(file, fit, psnr, f": {where}", exr=True),
            _figure(f"{file}-local", "Local RMS error", local, of_fit),
            _figure(f"{file}-flip", "HDR-FLIP", [f"mean {record['flip']['hdr']:.3f}"], of_fit),
        ]

    def scene(self, picture: Mapping[str, Any]) -> dict[str, Any]:
        """Data of a scene for the viewer."""
        references = [
            {
                "label": _KIND[kind],
                "picture": picture["references"][kind]["file"],
                "rows": self._numbers(picture, kind),
            }
            for kind in self.kinds
        ]
        return {
            "where": f"View {direction(picture['view'])}; light {direction(picture['light'])}; "
            f"{self._title(picture)}",
            "tiles_across": width(picture["tiles_across"]),
            "references": references,
            "fits": [picture["fits"][fit]["file"] for fit in self.fits],
        }

    def _numbers(self, picture: Mapping[str, Any], kind: str) -> list[list[str]]:
        """Rows of the viewer's table: name of the metric, then one cell per fit."""
        records = [picture["fits"][fit] for fit in self.fits]
        errors = [{name: estimate(e) for name, e in record["errors"][kind].items()} for record in records]
        rows = [
            ["MSE [10⁻³/sr²]", *(estimate_text(e["mse"], 1e3) for e in errors)],
            ["relative MSE", *(estimate_text(e["relative_mse"]) for e in errors)],
            ["PSNR", *(decibel(e["psnr"], e["mse"]) for e in errors)],
        ]
        if kind == self.kinds[0]:
            noise = picture["references"][kind]
            rows += [[m.title, *(m.text(m.of(r), m.of(noise)) for r in records)] for m in self._metrics]
            if len(records) > 1:
                cells = (estimate_text(estimate(r["mse_minus_first"]), 1e3) for r in records[1:])
                rows.append([f"MSE − MSE of {self.fits[0]} [10⁻³/sr²]", "–", *cells])
        return rows


def _figure(image: str, label: str, lines: list[str], where: str, *, exr: bool = False) -> dict[str, Any]:
    figure = {"image": image, "label": label, "lines": lines, "alt": f"{label}{where}"}
    return figure | {"file": exr_link(image) if exr else ""}


def exr_link(file: str) -> str:
    """Address, relative to the report, of an EXR file of the comparison."""
    return quote(f"{COMPARE}/{file.removesuffix('.exr')}.exr")
