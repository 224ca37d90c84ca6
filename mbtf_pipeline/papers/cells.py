"""Tables whose columns know how to compute, print and export their cells."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbtf_core.stats import Estimate, psnr
from mbtf_pipeline.compare.perceptual_metrics import PerceptualMetric
from mbtf_pipeline.compare.pictures import with_ending
from mbtf_pipeline.formatting import decibel, estimate_text, is_significant, signed
from mbtf_pipeline.report.embed import jpeg_uri, map_uri

_QUALITY = 86


class Shown(NamedTuple):
    """A number with a text of its own, and a second number for the column with this suffix of the CSV file:
    ``se`` for a standard error, ``noise`` for the value of noise alone."""

    text: str
    value: float
    second: float | None
    suffix: str


def psnr_cell(mse: Estimate, peak: float) -> Shown:
    """A PSNR in dB, from a noise-free MSE and the peak, both in units of 1/sr."""
    found = psnr(mse, peak)
    return Shown(decibel(found, mse), found.value, found.error, "se")


def perceptual_cell(metric: PerceptualMetric, value: float, noise: float | None) -> Shown:
    """Value of a perceptual metric, and its value for noise alone."""
    return Shown(metric.text(value, noise, with_noise=False), value, noise, "noise")


Cell = Estimate | Shown | float | int | str | None


@dataclass(frozen=True)
class Column:
    """A column.

    Attributes
    ----------
    title : on the page, with its unit
    key : in the CSV file, whose numbers are not scaled
    cell : computes the cell of a row from the row's items
    factor : from the stored number to the one on the page
    digits : format of plain numbers on the page
    """

    title: str
    key: str
    cell: Callable[..., Cell] = lambda *_: None
    factor: float = 1.0
    digits: str = ".3g"

    def text(self, cell: Cell) -> str:
        """A cell on the page."""
        if cell is None:
            return "–"
        if isinstance(cell, str):
            return cell
        if isinstance(cell, Shown):
            return cell.text
        if isinstance(cell, Estimate):
            return estimate_text(cell, self.factor)
        return f"{cell:,}" if isinstance(cell, int) else signed(f"{self.factor * cell:{self.digits}}")

    def numbers(self, cell: Cell) -> dict[str, str]:
        """A cell in the CSV file, by key."""
        if isinstance(cell, Shown):
            return {self.key: _number(cell.value), f"{self.key}_{cell.suffix}": _number(cell.second)}
        if isinstance(cell, Estimate):
            return {self.key: _number(cell.value), f"{self.key}_se": _number(cell.error)}
        return {self.key: _number(cell)}


def _number(x: float | str | None) -> str:
    if isinstance(x, float):
        return f"{x:.6g}" if math.isfinite(x) else ""
    return "" if x is None else str(x)


MATERIAL = Column("material", "material", lambda run, *_: run.title)
METHOD = Column("method", "method", lambda run, fit, *_: fit)


def rows_of(columns: Sequence[Column], items: Iterable[Sequence[Any]]) -> list[list[Cell]]:
    """One row per item; an item holds the arguments of the columns' functions."""
    return [[column.cell(*item) for column in columns] for item in items]


class Thumbnail(NamedTuple):
    """An image below a table: ``data:`` URI, label, and lines of its caption."""

    image: str
    label: str
    lines: Sequence[str] = ()


def preview(path: Path, label: str, *lines: str) -> Thumbnail:
    """An image of the comparison (path without suffix) at its exposure."""
    from PIL import Image

    with Image.open(with_ending(path, ".png")) as image:
        return Thumbnail(jpeg_uri(np.asarray(image.convert("RGB")), _QUALITY), label, lines)


def signed_map(values: NDArray[np.floating], scale: float, label: str, *lines: str) -> Thumbnail:
    """A signed map (rows, columns), saturated at ± `scale`."""
    return Thumbnail(map_uri((values / scale).astype(np.float64), "signed", 256), label, lines)


@dataclass(frozen=True)
class Table:
    """A table with a title, a text above it, plots, and titled rows of images."""

    key: str
    title: str
    text: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[Cell]]
    plots: Sequence[Mapping[str, str]] = ()
    images: Sequence[tuple[str, Sequence[Thumbnail]]] = ()

    def for_page(self) -> dict[str, Any]:
        """Head and rows as text."""
        rows = [[c.text(x) for c, x in zip(self.columns, row, strict=True)] for row in self.rows]
        return {"head": [c.title for c in self.columns], "rows": rows}

    def csv(self) -> str:
        """All numbers as CSV, with columns for standard errors and noise; unknown numbers are empty."""
        rows = [[c.numbers(x) for c, x in zip(self.columns, row, strict=True)] for row in self.rows]
        # Numbers precede their errors.
        names = [sorted({c.key}.union(*(row[k] for row in rows))) for k, c in enumerate(self.columns)]
        stream = io.StringIO()
        writer = csv.DictWriter(stream, [key for keys in names for key in keys], lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: x for cell in row for key, x in cell.items()} for row in rows)
        return stream.getvalue()


def mean_of(estimates: Sequence[Estimate]) -> Estimate:
    """Mean of independent estimates."""
    n = len(estimates)
    error = math.sqrt(sum(e.error**2 for e in estimates)) / n
    return Estimate(sum(e.value for e in estimates) / n, error, sum(e.n for e in estimates))


def ratio_of(upper: Estimate, lower: Estimate) -> Estimate:
    """Ratio of two independent estimates; undefined unless the lower one is significantly positive."""
    n = min(upper.n, lower.n)
    if lower.value <= 0 or not is_significant(lower):
        return Estimate(math.nan, math.inf, n)
    value = upper.value / lower.value
    return Estimate(value, math.hypot(upper.error, value * lower.error) / lower.value, n)
