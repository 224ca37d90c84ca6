"""Tables whose cells know how they are printed on a page and stored as CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from mbtf_core.stats import Estimate
from mbtf_pipeline.compare.perceptual_metrics import Measure
from mbtf_pipeline.formatting import decibel, error_text

NOT_BUILT = "not built yet"


@dataclass(frozen=True)
class Decibel:
    """PSNR with the noise-free MSE that it stands for."""

    psnr: Estimate
    mse: Estimate

    @classmethod
    def of(cls, mse: Estimate, peak: float) -> Decibel:
        """10 log10(peak²/MSE); infinite where the MSE is not positive."""
        if mse.value <= 0 or peak <= 0:
            return cls(Estimate(math.inf, math.inf, mse.n), mse)
        value = 10.0 * math.log10(peak**2 / mse.value)
        return cls(Estimate(value, 10.0 / math.log(10.0) * mse.relative_error, mse.n), mse)


@dataclass(frozen=True)
class Seen:
    """A visible difference, and what noise alone gives."""

    measure: Measure
    value: float
    noise: float | None


Cell = Estimate | Decibel | Seen | float | int | str | None


@dataclass(frozen=True)
class Column:
    """A column.

    Attributes
    ----------
    title : on the page, with its unit; key : in the CSV, whose numbers are in SI units and not scaled
    factor : from the stored number to the one on the page
    digits : of plain numbers on the page
    second : ending of a second CSV column: ``se`` (standard error) or ``noise`` (of noise alone); empty: none
    """

    title: str
    key: str
    factor: float = 1.0
    digits: str = ".3g"
    second: str = ""


@dataclass(frozen=True)
class Figure:
    """A picture of a table: ``data:`` URI, what it is, and lines below it."""

    image: str
    label: str
    lines: Sequence[str] = ()


@dataclass(frozen=True)
class Table:
    """A table with its title, the text above it, plots, and rows of figures with a title each."""

    key: str
    title: str
    text: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[Cell]]
    plots: Sequence[Mapping[str, str]] = ()
    figures: Sequence[tuple[str, Sequence[Figure]]] = field(default_factory=list)

    def for_page(self) -> dict[str, Any]:
        """Head and rows as text."""
        rows = [[_text(c, x) for c, x in zip(self.columns, row, strict=True)] for row in self.rows]
        return {"head": [c.title for c in self.columns], "rows": rows}

    def csv(self) -> str:
        """All numbers; what is not known, or not measured, is empty."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        head: list[str] = []
        for column in self.columns:
            head += [column.key, *([f"{column.key}_{column.second}"] if column.second else [])]
        writer.writerow(head)
        for row in self.rows:
            cells: list[str] = []
            for column, cell in zip(self.columns, row, strict=True):
                first, second = _numbers(cell)
                cells += [first, *([second] if column.second else [])]
            writer.writerow(cells)
        return stream.getvalue()


def _text(column: Column, cell: Cell) -> str:
    if cell is None:
        return "–"
    if isinstance(cell, str):
        return cell
    if isinstance(cell, Estimate):
        return error_text(cell, column.factor)
    if isinstance(cell, Decibel):
        return decibel(cell.psnr.as_dict(), cell.mse.as_dict())
    if isinstance(cell, Seen):
        more = ", not above noise alone" if cell.measure.is_noise(cell.value, cell.noise) else ""
        return f"{cell.value:.3f}{more}"
    if isinstance(cell, int):
        return f"{cell:,}"
    return f"{column.factor * cell:{column.digits}}".replace("-", "−")


def _number(x: float | None) -> str:
    return "" if x is None or not math.isfinite(x) else f"{x:.6g}"


def _numbers(cell: Cell) -> tuple[str, str]:
    """(value, standard error or noise) for the CSV."""
    if isinstance(cell, Estimate):
        return _number(cell.value), _number(cell.error)
    if isinstance(cell, Decibel):
        return _number(cell.psnr.value), _number(cell.psnr.error)
    if isinstance(cell, Seen):
        return _number(cell.value), _number(cell.noise)
    if cell is None or isinstance(cell, str):
        return cell or "", ""
    return (str(cell) if isinstance(cell, int) else _number(cell)), ""


def mean_of(estimates: Sequence[Estimate]) -> Estimate:
    """Mean of independent estimates, with the error that follows from theirs."""
    n = len(estimates)
    error = math.sqrt(sum(e.error**2 for e in estimates)) / n
    return Estimate(sum(e.value for e in estimates) / n, error, sum(e.n for e in estimates))


def ratio_of(upper: Estimate, lower: Estimate) -> Estimate:
    """Ratio of two estimates; their errors are taken as independent. Not defined where the lower one is not
    told from zero."""
    if lower.value <= 2.0 * lower.error:
        return Estimate(math.nan, math.inf, min(upper.n, lower.n))
    value = upper.value / lower.value
    error = math.hypot(upper.error, value * lower.error) / lower.value
    return Estimate(value, error, min(upper.n, lower.n))
