"""What the quality presets cost and reach, as ``benchmarks/quality.py --store`` measured it.

The figures lie beside this module as JSON, with the date and the kind of machine. ``mbtf-gen plan`` and a table
of the documentation show them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from mbtf_core.atomic import read_json
from mbtf_core.console import clock

STORED = Path(__file__).with_name("quality_measured.json")
FORMAT = "mbtf-quality"


@dataclass(frozen=True)
class PresetRun:
    """One material at a preset, from height map to report.

    Attributes
    ----------
    material, quality : names
    height_scale : factor on the stored heights; None for the material's own
    seconds : of the whole run, start-up included
    generate, fit : seconds of these two stages
    unexplained, unexplained_error : unexplained variance on test queries, and its standard error
    data_bytes, material_bytes : on disk
    queries_per_second : in training
    settings : hash of all options that the preset sets
    share : share of the preset's training time that the fit used
    """

    material: str
    quality: str
    height_scale: float | None
    seconds: float
    generate: float
    fit: float
    unexplained: float
    unexplained_error: float
    data_bytes: int
    material_bytes: int
    queries_per_second: float
    settings: str
    share: float = 1.0


@dataclass(frozen=True)
class Expected:
    """Measured and extrapolated figures of the presets.

    Attributes
    ----------
    date, machine, command : of the benchmark
    resolution : texels across
    runs : measured runs
    extrapolated : runs of presets that take too long to measure; their figures follow from measured runs
    law : how they follow, in words
    """

    date: str
    machine: str
    command: str
    resolution: int
    runs: tuple[PresetRun, ...]
    extrapolated: tuple[PresetRun, ...]
    law: str

    def of(self, quality: str) -> list[PresetRun]:
        """Measured runs of a preset; extrapolated ones where there are none."""
        return [c for c in self.runs if c.quality == quality and c.share == 1] or [
            c for c in self.extrapolated if c.quality == quality
        ]

    def line(self, quality: str) -> str | None:
        """``draft 0:41 to 0:52 in all, 0.31 to 0.62 unexplained``; None where nothing is known."""
        known = self.of(quality)
        if not known:
            return None
        guess = " (extrapolated)" if all(c not in self.runs for c in known) else ""
        times = _range([clock(c.seconds) for c in sorted(known, key=lambda c: c.seconds)])
        errors = _range([f"{c.unexplained:.2f}" for c in sorted(known, key=lambda c: c.unexplained)])
        return f"{quality} {times} in all, {errors} unexplained{guess}"


def _range(ordered: Sequence[str]) -> str:
    return ordered[0] if ordered[0] == ordered[-1] else f"{ordered[0]} to {ordered[-1]}"


def read_expected(path: Path) -> Expected:
    """Figures of a file.

    Raises
    ------
    InputError : the file is missing or damaged
    """
    data: dict[str, Any] = read_json(path)
    runs, guessed = (tuple(PresetRun(**row) for row in data[name]) for name in ("runs", "extrapolated"))
    return Expected(
        data["date"], data["machine"], data["command"], data["resolution"], runs, guessed, data["law"]
    )


@cache
def expected() -> Expected:
    """The figures that come with the package."""
    return read_expected(STORED)


_HEAD = (
    "quality",
    "material",
    "in all",
    "generating",
    "fitting",
    "unexplained variance",
    "data",
    "weights",
)


def markdown_table(found: Expected, qualities: Sequence[str]) -> str:
    """Markdown table of the presets' figures, and how the extrapolated ones follow."""
    if not found.runs:
        return "No figures are stored."
    rows = ["| " + " | ".join(_HEAD) + " |", "|" + "---|" * len(_HEAD)]
    for quality in qualities:
        for c in found.of(quality):
            guess = "" if c in found.runs else ", extrapolated"
            error = f" ± {c.unexplained_error:.3f}" if c.unexplained_error > 0 else ""
            scale = "" if c.height_scale is None else f", height scale {c.height_scale:g}"
            cells = (
                f"`{quality}`{guess}",
                f"{c.material}{scale}",
                clock(c.seconds),
                clock(c.generate),
                clock(c.fit),
                f"{c.unexplained:.3f}{error}",
                f"{c.data_bytes / 1e6:.0f} MB",
                f"{c.material_bytes / 1e6:.2f} MB",
            )
            rows.append("| " + " | ".join(cells) + " |")
    if found.extrapolated:
        rows += ["", f"{found.law}."]
    return "\n".join(rows)
