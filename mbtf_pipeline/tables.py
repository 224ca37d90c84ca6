"""Measured numbers as text, and tables whose columns compute, print and export their cells."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from mbtf_core.stats import SIGNIFICANT, Estimate, is_significant

NOT_SIGNIFICANT = "not significant"


estimate = Estimate.from_dict


def estimate_text(e: Estimate, factor: float = 1.0) -> str:
    """``0.123 ± 0.004``, or ``not significant (0.003 ± 0.004)``."""
    if not math.isfinite(e.value):
        return "undefined"
    text = signed(str(e.scaled(factor)))
    return text if is_significant(e) else not_significant(text)


def not_significant(text: str) -> str:
    """A number's text marked as not significantly different from zero."""
    return f"{NOT_SIGNIFICANT} ({text})"


def signed(text: str) -> str:
    """The text of a number with a true minus sign."""
    return text.replace("-", "−")


def data_errors(record: Mapping[str, Any]) -> tuple[str, str]:
    """(unexplained variance, MSE in 10⁻³/sr²) of the same queries.

    The former is the latter divided by the variance of the values: a highlight adds to both, so that the
    quotient may be significant where the MSE is not. An unexplained variance that may be below 0 and above 1
    has no number.
    """
    unexplained, mse = estimate(record["unexplained"]), estimate(record["mse"])
    text = estimate_text(unexplained)
    if not is_significant(unexplained) and unexplained.value + SIGNIFICANT * unexplained.error > 1.0:
        text = NOT_SIGNIFICANT
    return text, estimate_text(mse, 1e3)


def decibel(psnr: Estimate, mse: Estimate) -> str:
    """PSNR in dB, marked where the MSE is not significant."""
    if not math.isfinite(psnr.value):
        return f"MSE {NOT_SIGNIFICANT}"
    text = signed(f"{psnr} dB")
    return text if is_significant(mse) else f"MSE {not_significant(text)}"


def direction(d: Mapping[str, float]) -> str:
    """``elevation 45°, azimuth −90°``."""
    return signed(f"elevation {d['elevation']:g}°, azimuth {d['azimuth']:g}°")


def short_direction(d: Mapping[str, float]) -> str:
    """``45° / −90°``: elevation and azimuth."""
    return signed(f"{d['elevation']:g}° / {d['azimuth']:g}°")


def levels_text(found: list[float], finest: int) -> str:
    """Range of levels in an image, and whether the data contain them."""
    low, high = (f"{level:.1f}" for level in found)
    text = f"level {low}" if low == high else f"level {low}–{high}"
    return text if found[1] <= finest + 0.1 else f"{text} (finest level of the data: {finest})"


class Shown(NamedTuple):
    """A number with a text of its own, and a second number for the column with this suffix of the CSV file:
    ``se`` for a standard error, ``noise`` for the value of noise alone."""

    text: str
    value: float
    second: float | None
    suffix: str


Cell = Estimate | Shown | float | int | str | None


@dataclass(frozen=True)
class Column:
    """A column of a :class:`Table`.

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


def rows_of(columns: Sequence[Column], items: Iterable[Sequence[Any]]) -> list[list[Cell]]:
    """One row per item; an item holds the arguments of the columns' functions."""
    return [[column.cell(*item) for column in columns] for item in items]


class Thumbnail(NamedTuple):
    """An image below a table: ``data:`` URI, label, and a line below it."""

    image: str
    label: str
    line: str = ""


@dataclass(frozen=True)
class Table:
    """A table with a title, plots, and titled rows of images."""

    key: str
    title: str
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
