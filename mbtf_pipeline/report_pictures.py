"""The report's pictures: rows of references, fits and differences; half-and-half pictures; offsets."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_gen.reference import to_display
from mbtf_gen.stats import Estimate

from .embed import F32, U8, difference_picture, difference_scale, round_scale, signed_colours
from .offsets import read_offset, towards_view
from .pictures import read_picture
from .recipe import View

Maker = Callable[[], U8]
_HEROES = 3


def estimate(record: Mapping[str, Any]) -> Estimate:
    """An estimate read back from JSON, where numbers that are not finite are null."""
    value, error = record["value"], record["error"]
    return Estimate(math.nan if value is None else value, math.inf if error is None else error, record["n"])


def percent(e: Estimate, digits: int = 2) -> str:
    """``12.3 ± 0.4 %``."""
    return f"{e.scaled(100.0)} %" if math.isfinite(e.value) else "not defined"


def decibel(record: Mapping[str, Any]) -> str:
    """PSNR in words; null stands for an error below the reference's noise."""
    e = estimate(record)
    return f"PSNR {e} dB" if math.isfinite(e.value) else "error below the noise"


@dataclass
class Gallery:
    """Pictures by name, made when they are encoded.

    Attributes
    ----------
    makers : name → function that makes the pixels
    """

    makers: dict[str, Maker] = field(default_factory=dict)

    def add(self, name: str, maker: Maker) -> str:
        """Register a picture; returns its name."""
        self.makers[name] = maker
        return name


def _direction(d: Mapping[str, float]) -> str:
    return f"elevation {d['elevation']:g}°, azimuth {d['azimuth']:g}°".replace("-", "−")


def diagram(view: Mapping[str, float], light: Mapping[str, float]) -> str:
    """The hemisphere from above with the view (square) and the light (disk), as an ``<svg>`` element."""

    def place(d: Mapping[str, float]) -> tuple[float, float]:
        r = 20.0 * math.cos(math.radians(d["elevation"]))
        a = math.radians(d["azimuth"])
        return r * math.cos(a), -r * math.sin(a)

    (vx, vy), (lx, ly) = place(view), place(light)
    text = f"view {_direction(view)}; light {_direction(light)}"
    return (
        f'<svg viewBox="-24 -24 48 48" role="img" aria-label="{text}"><title>{text}</title>'
        '<g fill="none" stroke="currentColor" opacity=".35"><circle r="20"/><circle r="10"/>'
        '<path d="M-20 0H20M0-20V20" stroke-width=".6"/></g>'
        f'<rect x="{vx - 3.4:.2f}" y="{vy - 3.4:.2f}" width="6.8" height="6.8" rx="1" fill="var(--accent)"/>'
        f'<circle cx="{lx:.2f}" cy="{ly:.2f}" r="3.9" fill="#e69f00"/></svg>'
    )


@dataclass(frozen=True)
class Shown:
    """The comparison's pictures as the page needs them.

    Attributes
    ----------
    groups : per view and light: title, diagram, rows of cells
    heroes : reference and first fit in one picture
    columns : cells per row
    scale : end of the difference scale, as a share of white
    """

    groups: list[dict[str, Any]]
    heroes: list[dict[str, Any]]
    columns: int
    scale: float


def show_pictures(
    folder: Path, comparison: Mapping[str, Any], white: float, stops: list[float], gallery: Gallery
) -> Shown:
    """Lay out all pictures of a comparison.

    Parameters
    ----------
    folder : of the comparison
    white : linear value at display white, 1/sr, at stop 0
    """
    values: dict[str, F32] = {}

    def value(file: str) -> F32:
        if file not in values:
            values[file] = read_picture(folder / file)
        return values[file]

    def displayed(file: str) -> list[str]:
        def maker(stop: float) -> Maker:
            return lambda: to_display(value(file), 2.0**stop / white)

        return [gallery.add(f"{file}@{stop:g}", maker(stop)) for stop in stops]

    pictures, fits, kinds = comparison["pictures"], comparison["fits"], comparison["kinds"]
    main_kind = "query" if "query" in kinds else kinds[0]
    pairs = [
        (value(p["fits"][fit]["file"]), value(p["references"][main_kind]["file"]))
        for p in pictures
        for fit in fits
    ]
    scale = difference_scale(pairs, white)
    groups: list[dict[str, Any]] = []
    for picture in pictures:
        key = (picture["view"], picture["light"])
        if not groups or groups[-1]["key"] != key:
            groups.append(
                {
                    "key": key,
                    "index": len(groups),
                    "title": f"View {_direction(key[0])}  ·  light {_direction(key[1])}",
                    "diagram": diagram(*key),
                    "rows": [],
                }
            )
        rows = groups[-1]["rows"]
        where = f"view {_direction(key[0])}, light {_direction(key[1])}, {_width(picture['span'])}"
        cells = []
        for kind in sorted(kinds, key=lambda k: k == "query"):
            reference = picture["references"][kind]
            label = "Reference" if kind == "query" else "Reference, filtered pixel"
            lines = [f"noise {estimate(reference['noise']).value:.1%} per pixel"]
            if kind == main_kind:
                lines.insert(
                    0, f"{_width(picture['span'])}, {_levels(picture['levels'], comparison['finest'])}"
                )
            elif "between_references" in picture:
                lines.insert(0, _between(estimate(picture["between_references"]), white))
            cells.append(_cell(displayed(reference["file"]), label, lines, f"{label}: {where}"))
        for fit in fits:
            made = picture["fits"][fit]
            errors = made["errors"][main_kind]
            lines = [decibel(errors["psnr"]), f"relative MSE {estimate(errors['relative_mse'])}"]
            cells.append(_cell(displayed(made["file"]), fit, lines, f"{fit}: {where}"))
            name = gallery.add(
                f"{made['file']}-difference",
                _difference(
                    value(made["file"]), value(picture["references"][main_kind]["file"]), scale * white
                ),
            )
            line = _root(estimate(errors["mse"]), white)
            cells.append(_cell([name], f"{fit} − reference", [line], f"{fit} minus reference: {where}"))
        rows.append({"index": len(rows), "cells": cells})
    heroes = _heroes(pictures, fits, main_kind, value, white, gallery)
    columns = len(kinds) + 2 * len(fits)
    return Shown(groups, heroes, columns, scale)


def _between(difference: Estimate, white: float) -> str:
    """How far the two kinds of reference are apart."""
    if difference.value <= 2.0 * difference.error:
        return "differs by less than noise"
    return f"differs by {math.sqrt(difference.value) / white:.1%} of white"


def _root(mse: Estimate, white: float) -> str:
    """Root mean square error, the reference's noise taken out."""
    if mse.value <= 0:
        return "error below the noise"
    root = math.sqrt(mse.value) / white
    return f"RMS {Estimate(100 * root, 100 * root * mse.relative_error / 2, mse.n)} % of white"


def _levels(levels: list[float], finest: int) -> str:
    """Levels that a picture asks for, and whether the data have them."""
    low, high = (f"{level:.1f}" for level in levels)
    text = f"level {low}" if low == high else f"level {low}–{high}"
    return text if levels[1] <= finest + 0.1 else f"{text} (finest of the data {finest})"


def _width(span: float) -> str:
    return f"{span:g} tile{'' if span == 1 else 's'} across"


def _cell(images: list[str], label: str, lines: list[str], alt: str) -> dict[str, Any]:
    return {"images": images, "label": label, "lines": lines, "alt": alt}


def _difference(fit: F32, reference: F32, scale: float) -> Maker:
    return lambda: difference_picture(fit, reference, scale)


def halves(left: F32, right: F32, white: float) -> U8:
    """Left half of one picture, right half of another, a thin line between."""
    middle = left.shape[1] // 2
    joined = np.concatenate([left[:, :middle], right[:, middle:]], axis=1)
    out = to_display(joined, 1.0 / white)
    out[:, middle - 1 : middle + 1] = 255
    return out


def _heroes(
    pictures: list[dict[str, Any]],
    fits: list[str],
    kind: str,
    value: Callable[[str], F32],
    white: float,
    gallery: Gallery,
) -> list[dict[str, Any]]:
    """Up to three pictures, of different views and lights where there are such, at the first span."""
    first = [p for p in pictures if p["span"] == pictures[0]["span"]]
    picked: list[dict[str, Any]] = []
    views: list[Any] = []
    lights: list[Any] = []
    for picture in first:
        if picture["view"] not in views and (picture["light"] not in lights or len(lights) == _HEROES):
            picked.append(picture)
            views.append(picture["view"])
            lights.append(picture["light"])
    picked += [p for p in first if p not in picked]
    out = []
    for picture in picked[:_HEROES]:
        left, right = value(picture["references"][kind]["file"]), value(picture["fits"][fits[0]]["file"])

        def maker(left: F32 = left, right: F32 = right) -> U8:
            return halves(left, right, white)

        name = gallery.add(f"{picture['name']}-halves", maker)
        caption = f"View {_direction(picture['view'])}; light {_direction(picture['light'])}"
        out.append({"image": name, "caption": caption})
    return out


def show_offsets(folder: Path, records: list[dict[str, Any]], gallery: Gallery) -> list[dict[str, Any]]:
    """Rows of offset pictures: traced, then each fit that learns one; each row with its own scale."""
    if not records:
        return []
    rows: list[tuple[str | None, str]] = [(None, "Traced from the heights")]
    rows += [(name, f"Learned by {name}") for name in records[0]["fits"]]
    out = []
    for index, (what, title) in enumerate(rows):
        fields = []
        for record in records:
            file = record["traced"] if what is None else record["fits"][what]["file"]
            fields.append(towards_view(read_offset(folder / file), View(**record["view"])))
        medians = [float(np.median(f)) for f in fields]
        fields = [f - m for f, m in zip(fields, medians, strict=True)]
        scale = round_scale(float(np.percentile(np.abs(np.stack(fields)), 99)))
        cells: list[dict[str, Any]] = []
        for record, shown, median in zip(records, fields, medians, strict=True):

            def maker(shown: F32 = shown, scale: float = scale) -> U8:
                return signed_colours(shown / scale)

            name = gallery.add(f"offset-{index}-{len(cells)}", maker)
            lines = [
                f"view {_direction(record['view'])}",
                f"median {median:.2g} tile widths".replace("-", "−"),
            ]
            if what is not None and record["fits"][what]["correlation"] is not None:
                lines.append(f"correlation with the traced one {record['fits'][what]['correlation']:.2f}")
            alt = f"{title}, view {_direction(record['view'])}"
            cells.append({"image": name, "label": title, "lines": lines, "alt": alt})
        out.append(
            {
                "index": index,
                "cells": cells,
                "low": f"−{scale:g}",
                "high": f"+{scale:g} tile widths",
                "scale_text": "towards the viewer's azimuth, less each picture's median",
            }
        )
    return out
