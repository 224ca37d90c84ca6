"""What the qualities cost and reach, as ``benchmarks/quality.py --store`` measured it.

The figures lie beside this module as JSON with the date and the kind of machine; help texts, what
``mbtf-gen plan`` says and the table of docs/cost.md are made from them.
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
class Chain:
    """One material at a quality, from height map to report.

    Attributes
    ----------
    material, quality : names; height : of the relief in tile widths, None for the material's own
    seconds : of the whole chain, start-up included; generate, fit : of these two stages
    unexplained, unexplained_error : variance of test queries that the fit misses, and its standard error
    data_bytes, material_bytes : on disk
    queries_per_second : trained on
    settings : hash of all that the quality set
    share : of the quality's training time that it trained for
    """

    material: str
    quality: str
    height: float | None
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
    """All that is known of the qualities.

    Attributes
    ----------
    date, machine, command : of the run; levels : finest level of its materials
    chains : measured ones
    extrapolated : qualities that nobody waited for, as chains whose figures follow from measured ones
    law : how they follow, in words
    """

    date: str
    machine: str
    command: str
    levels: int
    chains: tuple[Chain, ...]
    extrapolated: tuple[Chain, ...]
    law: str

    def of(self, quality: str) -> list[Chain]:
        """Measured chains of a quality; extrapolated ones where there are none."""
        return [c for c in self.chains if c.quality == quality and c.share == 1] or [
            c for c in self.extrapolated if c.quality == quality
        ]

    def line(self, quality: str) -> str | None:
        """``draft 0:41 to 0:52 in all, 0.31 to 0.62 unexplained``; None where nothing is known."""
        known = self.of(quality)
        if not known:
            return None
        guess = " (extrapolated)" if all(c not in self.chains for c in known) else ""
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
    chains, guessed = (tuple(Chain(**row) for row in data[name]) for name in ("chains", "extrapolated"))
    return Expected(
        data["date"], data["machine"], data["command"], data["levels"], chains, guessed, data["law"]
    )


@cache
def expected() -> Expected:
    """The figures that come with the package."""
    return read_expected(STORED)


def help_lines(qualities: Sequence[str]) -> str:
    """What ``--help`` says of the qualities."""
    found = expected()
    lines = [line for quality in qualities if (line := found.line(quality)) is not None]
    if not lines:
        return ""
    return f"Measured with {1 << found.levels} texels across on {found.machine}: {'; '.join(lines)}."


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
    """The table of docs/cost.md, and how what is extrapolated follows."""
    if not found.chains:
        return "No figures are stored."
    rows = ["| " + " | ".join(_HEAD) + " |", "|" + "---|" * len(_HEAD)]
    for quality in qualities:
        for c in found.of(quality):
            guess = "" if c in found.chains else ", extrapolated"
            error = f" ± {c.unexplained_error:.3f}" if c.unexplained_error > 0 else ""
            relief = "" if c.height is None else f", relief {c.height:g}"
            cells = (
                f"`{quality}`{guess}",
                f"{c.material}{relief}",
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
