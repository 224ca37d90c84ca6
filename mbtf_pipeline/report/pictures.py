"""The report's pictures: the viewer's scenes, and the sheet of references, fits and error maps."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_pipeline.compare.perceptual_metrics import measured, visible_text
from mbtf_pipeline.compare.pictures import read_halves, read_map, read_picture
from mbtf_pipeline.formatting import decibel, direction, error_text, estimate, levels, short_direction, width
from mbtf_pipeline.report.embed import F32, Field, Gallery
from mbtf_pipeline.report.error_maps import Palette, common_scale, gradient, local_error, ticks

# Sides that a picture's name and caption tell apart.
_KIND = {"query": "Reference", "pixel": "Reference, filtered pixel"}


def diagram(view: Mapping[str, float], light: Mapping[str, float]) -> str:
    """The hemisphere from above with the view (square) and the light (disk), as an ``<svg>`` element."""

    def place(d: Mapping[str, float]) -> tuple[float, float]:
        r = 20.0 * math.cos(math.radians(d["elevation"]))
        a = math.radians(d["azimuth"])
        return r * math.cos(a), -r * math.sin(a)

    (vx, vy), (lx, ly) = place(view), place(light)
    return (
        '<svg viewBox="-24 -24 48 48" aria-hidden="true">'
        '<g fill="none" stroke="currentColor" opacity=".35"><circle r="20"/><circle r="10"/>'
        '<path d="M-20 0H20M0-20V20" stroke-width=".6"/></g>'
        f'<rect x="{vx - 3.4:.2f}" y="{vy - 3.4:.2f}" width="6.8" height="6.8" rx="1" fill="var(--accent)"/>'
        f'<circle cx="{lx:.2f}" cy="{ly:.2f}" r="3.9" fill="#e69f00"/></svg>'
    )


@dataclass(frozen=True)
class Bar:
    """A labeled color bar.

    Attributes
    ----------
    key : which map it belongs to; title : what is shown
    gradient : CSS; ticks : numbers from end to end; unit : of the numbers
    note : how the quantity is made
    """

    key: str
    title: str
    gradient: str
    ticks: list[str]
    unit: str
    note: str

    @classmethod
    def of(cls, key: str, palette: Palette, title: str, numbers: list[str], unit: str, note: str) -> Bar:
        """The bar of a palette."""
        return cls(key, title, gradient(palette), numbers, unit, note)


@dataclass(frozen=True)
class Shown:
    """The comparison's pictures as the page needs them.

    Attributes
    ----------
    groups : per view and light: title, diagram, blocks of figures, one block per width
    scenes : what the viewer can show, plain data
    bars : of the maps: local error, HDR-FLIP, signed difference
    difference : end of the signed scale, as a share of white
    """

    groups: list[dict[str, Any]]
    scenes: list[dict[str, Any]]
    bars: list[Bar]
    difference: float


def show_pictures(folder: Path, comparison: Mapping[str, Any], gallery: Gallery) -> Shown:
    """Lay out all pictures of a comparison.

    Parameters
    ----------
    folder : of the comparison
    gallery : takes the pictures; errors are shown as shares of its white
    """
    pictures, fits = comparison["pictures"], comparison["fits"]
    kinds = sorted(comparison["kinds"], key=lambda kind: kind != "query")
    white = gallery.white
    errors = {
        p["fits"][fit]["file"]: _errors(folder, p["fits"][fit]["file"], p["references"][kinds[0]]["file"])
        for p in pictures
        for fit in fits
    }
    scales = [
        common_scale([e[i] / unit for e in errors.values()]) for i, unit in enumerate((white, 1.0, white))
    ]
    scales[1] = min(scales[1], 1.0)
    sheet = _Sheet(folder, comparison, kinds, gallery)
    for file, (local, visible, _) in errors.items():
        sheet.chart(file, "local", "size", local / (scales[0] * white))
        sheet.chart(file, "flip", "flip", visible / scales[1])
    groups: list[dict[str, Any]] = []
    scenes = []
    for number, picture in enumerate(pictures):
        key = (picture["view"], picture["light"])
        if not groups or groups[-1]["key"] != key:
            groups.append(
                {
                    "key": key,
                    "title": f"View {direction(key[0])}  ·  light {direction(key[1])}",
                    "diagram": diagram(*key),
                    "short": [f"view {short_direction(key[0])}", f"light {short_direction(key[1])}"],
                    "blocks": [],
                }
            )
        groups[-1]["blocks"].append(sheet.block(number, picture))
        scenes.append({"group": len(groups) - 1, **sheet.scene(picture)})
    return Shown(groups, scenes, _bars(scales), scales[2])


def _errors(folder: Path, fit: str, reference: str) -> tuple[Field, Field, Field]:
    """(local error in 1/sr, HDR-FLIP, mean over channels of the signed difference in 1/sr)."""
    a, b = read_halves(folder / reference)
    value = read_picture(folder / fit)
    signed = (value.astype(np.float64) - 0.5 * (a.astype(np.float64) + b)).mean(axis=-1)
    return local_error(value, a, b), read_map(folder / fit), signed


def _bars(scales: list[float]) -> list[Bar]:
    local, visible, signed = scales
    return [
        Bar.of(
            "local",
            "size",
            "Local RMS error",
            ticks(0, local, 100),
            "% of white",
            "without the reference’s noise: root of (p−a)(p−b) averaged over the channels and a Gaussian "
            "window of 2 pixels; 0 where that average is negative: there the error lies below the noise",
        ),
        Bar.of(
            "flip",
            "flip",
            "HDR-FLIP",
            ticks(0, visible),
            "of 1, the largest",
            "how visible the difference is at −2, 0 and +2 EV, the worst of the three; the reference’s noise "
            "counts",
        ),
        Bar.of(
            "signed",
            "signed",
            "Fit − reference",
            ticks(-signed, signed, 100),
            "% of white",
            "mean of the channels; blue is too dark, orange too bright; the reference’s noise shows",
        ),
    ]


class _Sheet:
    """Figures of the sheet and scenes of the viewer, with their pictures put into the gallery."""

    def __init__(
        self, folder: Path, comparison: Mapping[str, Any], kinds: list[str], gallery: Gallery
    ) -> None:
        self._folder = folder
        self._comparison = comparison
        self._kinds = kinds
        self._gallery = gallery

    def chart(self, file: str, key: str, palette: Palette, values: Field) -> None:
        self._gallery.charts[f"{file}-{key}"] = (palette, lambda: values)

    def _linear(self, file: str) -> str:
        self._gallery.linear[file] = _reader(self._folder / file)
        return file

    def block(self, number: int, picture: Mapping[str, Any]) -> dict[str, Any]:
        """Figures of one scene: rows of four, references in the first column."""
        angles = f"view {direction(picture['view'])}, light {direction(picture['light'])}"
        where = f"{angles}, {width(picture['tiles_across'])}"
        cells: list[list[dict[str, Any] | None]] = []
        references = [self._reference(picture, kind, where) for kind in self._kinds]
        for index in range(max(len(references), len(self._comparison["fits"]))):
            row: list[dict[str, Any] | None] = [references[index] if index < len(references) else None]
            if index < len(self._comparison["fits"]):
                row += self._fit(picture, self._comparison["fits"][index], where)
            cells.append(row)
        level = levels(picture["levels"], self._comparison["finest"])
        return {"title": f"{width(picture['tiles_across'])}, {level}", "rows": cells, "scene": number}

    def _reference(self, picture: Mapping[str, Any], kind: str, where: str) -> dict[str, Any]:
        reference = picture["references"][kind]
        label = _KIND[kind]
        lines = [f"noise {100 * estimate(reference['noise']).value:.1f} % per pixel"]
        if kind != self._kinds[0] and "between_references" in picture:
            lines.append(
                f"MSE to the other {error_text(estimate(picture['between_references']), 1e3)} · 10⁻³/sr²"
            )
        return {
            "image": self._linear(reference["file"]),
            "linear": True,
            "label": label,
            "lines": lines,
            "alt": f"{label}: {where}",
        }

    def _fit(self, picture: Mapping[str, Any], fit: str, where: str) -> list[dict[str, Any] | None]:
        made = picture["fits"][fit]
        errors = made["errors"][self._kinds[0]]
        file = made["file"]
        return [
            {
                "image": self._linear(file),
                "linear": True,
                "label": fit,
                "lines": [f"PSNR {decibel(errors['psnr'], errors['mse'])}"],
                "alt": f"{fit}: {where}",
            },
            {
                "image": f"{file}-local",
                "linear": False,
                "label": "Local RMS error",
                "lines": [f"MSE {error_text(estimate(errors['mse']), 1e3)} · 10⁻³/sr²"],
                "alt": f"local RMS error of {fit}: {where}",
            },
            {
                "image": f"{file}-flip",
                "linear": False,
                "label": "HDR-FLIP",
                "lines": [f"mean {made['flip']['hdr']:.3f}"],
                "alt": f"HDR-FLIP of {fit}: {where}",
            },
        ]

    def scene(self, picture: Mapping[str, Any]) -> dict[str, Any]:
        """What the viewer shows of a scene."""
        level = levels(picture["levels"], self._comparison["finest"])
        return {
            "where": f"View {direction(picture['view'])}; light {direction(picture['light'])}; "
            f"{width(picture['tiles_across'])}, {level}",
            "tiles_across": width(picture["tiles_across"]),
            "references": [
                {
                    "label": _KIND[kind],
                    "picture": picture["references"][kind]["file"],
                    "rows": self._numbers(picture, kind),
                }
                for kind in self._kinds
            ],
            "fits": [picture["fits"][fit]["file"] for fit in self._comparison["fits"]],
        }

    def _numbers(self, picture: Mapping[str, Any], kind: str) -> list[list[str]]:
        """Rows of the viewer's table: what, then one cell per fit."""
        made = [picture["fits"][fit] for fit in self._comparison["fits"]]
        errors = [m["errors"][kind] for m in made]
        rows = [
            ["MSE [10⁻³/sr²]", *(error_text(estimate(e["mse"]), 1e3) for e in errors)],
            ["relative MSE", *(error_text(estimate(e["relative_mse"])) for e in errors)],
            ["PSNR", *(decibel(e["psnr"], e["mse"]) for e in errors)],
        ]
        if kind == self._kinds[0]:
            reference = picture["references"][kind]
            rows += [
                [m.title, *(visible_text(m, record, reference) for record in made)]
                for m in measured([picture], self._comparison["fits"])
            ]
            if len(made) > 1:
                cells = (error_text(estimate(m["mse_less_first"]), 1e3) for m in made[1:])
                rows.append([f"MSE less {self._comparison['fits'][0]}’s [10⁻³/sr²]", "–", *cells])
        return rows


def _reader(path: Path) -> Callable[[], F32]:
    @lru_cache(maxsize=1)
    def read() -> F32:
        return read_picture(path)

    return read
