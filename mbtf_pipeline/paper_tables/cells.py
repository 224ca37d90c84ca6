"""Tables whose columns know how to compute, print and export their cells."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from mbtf_core.stats import Estimate
from mbtf_pipeline.compare.metrics import psnr
from mbtf_pipeline.compare.perceptual_metrics import PerceptualMetric
from mbtf_pipeline.formatting import decibel, estimate_text, is_significant, signed

NOT_IMPLEMENTED = "not implemented"


@dataclass(frozen=True)
class Psnr:
    """A PSNR, given by a noise-free MSE and the peak, both in units of 1/sr."""

    mse: Estimate
    peak: float

    @property
    def value(self) -> Estimate:
        """In dB."""
        return psnr(self.mse, self.peak)


@dataclass(frozen=True)
class PerceptualCell:
    """Value of a perceptual metric, and its value for noise alone."""

    metric: PerceptualMetric
    value: float
    noise: float | None


Cell = Estimate | Psnr | PerceptualCell | float | int | str | None


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


MATERIAL = Column("material", "material", lambda run, *_: run.title)
METHOD = Column("method", "method", lambda run, fit, *_: fit)


def rows_of(columns: Sequence[Column], items: Iterable[Sequence[Any]]) -> list[list[Cell]]:
    """One row per item; an item holds the arguments of the columns' functions."""
    return [[column.cell(*item) for column in columns] for item in items]


@dataclass(frozen=True)
class Thumbnail:
    """An image below a table: ``data:`` URI, label, and lines of its caption."""

    image: str
    label: str
    lines: Sequence[str] = ()


@dataclass(frozen=True)
class Table:
    """A table with a title, a text above it, plots, and titled rows of images."""

    key: str
    title: str
    text: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[Cell]]
    plots: Sequence[Mapping[str, str]] = ()
    images: Sequence[tuple[str, Sequence[Thumbnail]]] = field(default_factory=list)

    def for_page(self) -> dict[str, Any]:
        """Head and rows as text."""
        rows = [[_text(c, x) for c, x in zip(self.columns, row, strict=True)] for row in self.rows]
        return {"head": [c.title for c in self.columns], "rows": rows}

    def csv(self) -> str:
        """All numbers as CSV, with columns for standard errors and noise; unknown numbers are empty."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        suffixes = [max(map(_suffix, cells)) for cells in zip(*self.rows, strict=True)]
        names = [(c.key, f"{c.key}_{s}") for c, s in zip(self.columns, suffixes, strict=True)]
        for row in (names, *([_numbers(cell) for cell in row] for row in self.rows)):
            pairs = zip(row, suffixes, strict=True)
            writer.writerow(x for pair, s in pairs for x in (pair if s else pair[:1]))
        return stream.getvalue()


def _text(column: Column, cell: Cell) -> str:
    if cell is None:
        return "–"
    if isinstance(cell, str):
        return cell
    if isinstance(cell, Estimate):
        return estimate_text(cell, column.factor)
    if isinstance(cell, Psnr):
        return decibel(cell.value, cell.mse)
    if isinstance(cell, PerceptualCell):
        return cell.metric.text(cell.value, cell.noise, with_noise=False)
    if isinstance(cell, int):
        return f"{cell:,}"
    return signed(f"{column.factor * cell:{column.digits}}")


def _number(x: float | None) -> str:
    return "" if x is None or not math.isfinite(x) else f"{x:.6g}"


def _suffix(cell: Cell) -> str:
    """Suffix of the second CSV column: standard error, value for noise alone, or none."""
    if isinstance(cell, Estimate | Psnr):
        return "se"
    return "noise" if isinstance(cell, PerceptualCell) else ""


def _numbers(cell: Cell) -> tuple[str, str]:
    """(value, standard error or noise) for the CSV file."""
    if isinstance(cell, Psnr):
        cell = cell.value
    if isinstance(cell, Estimate):
        return _number(cell.value), _number(cell.error)
    if isinstance(cell, PerceptualCell):
        return _number(cell.value), _number(cell.noise)
    if cell is None or isinstance(cell, str | int):
        return ("" if cell is None else str(cell)), ""
    return _number(cell), ""


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
