"""Many noisy queries or few clean ones? Held-out error of a fit at equal numbers of paths.

    python benchmarks/query_split.py [MATERIAL ...] [--paths 2e6 --paths 8e6] [--spp 2 ...] [--time 15s]
                                     [--levels 6] [--height H] [--plot FILE]

For every material (by default three of ``assets/``), budget of paths and number of paths per query a data set
is made, a ``neumip`` trained on it for the same time, and judged by test queries that all share. Prints the
unexplained variance, and for each budget the number of paths per query that left least.

The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mbtf_gen.config import GeneratorConfig
from mbtf_gen.durations import parse_duration
from mbtf_gen.errors import MbtfError
from mbtf_pipeline.cost.chains import Chain, Workshop
from mbtf_pipeline.plots import Cloud, scatter

ROOT = Path(__file__).resolve().parents[1]
ASSETS = ("cliff_rock", "straight_wool", "turtle_shell")
SPP = (2, 4, 8, 16, 64, 256)
PATHS = (2e6, 8e6)


def measure(
    material: Path,
    height: float | None,
    levels: int,
    budgets: Sequence[float],
    spps: Sequence[int],
    time: str,
) -> list[dict[str, Any]]:
    """One row per budget and number of paths per query."""
    config = GeneratorConfig.model_validate(
        {
            "material": str(material),
            "geometry": {"height": height},
            "queries": {"levels": levels, "test": "32768", "test_spp": 256},
        }
    )
    rows = []
    fit = {"model": "neumip", "training": {"time": time}}
    with tempfile.TemporaryDirectory() as work:
        shop = Workshop(
            config, Path(work), "", lambda note: print(f"{material.name}: {note}", file=sys.stderr)
        )
        for budget in budgets:
            for spp in spps:
                queries = max(1, int(budget) // spp)
                point = shop.measure(Chain("data", f"{budget:g} paths", f"{spp}", queries, spp, fit))
                shop.forget(queries, spp)
                rows.append(
                    {
                        "material": material.name,
                        "paths": int(budget),
                        "spp": spp,
                        "queries": queries,
                        "unexplained": point.error.as_dict(),
                        "generation_seconds": round(point.details["generation_seconds"], 2),
                    }
                )
                print(
                    f"{material.name:16s} {budget / 1e6:6.1f} M paths  {spp:4d} per query  {point.error}",
                    flush=True,
                )
    return rows


def best(rows: Sequence[dict[str, Any]]) -> dict[str, int]:
    """Number of paths per query that left least, by material and budget."""
    found: dict[str, dict[str, Any]] = {}
    for row in rows:
        key = f"{row['material']} {row['paths'] / 1e6:g}M"
        value = row["unexplained"]["value"]
        if value is not None and (key not in found or value < found[key]["unexplained"]["value"]):
            found[key] = row
    return {key: row["spp"] for key, row in found.items()}


def plot(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Unexplained variance over paths per query, a line per material and budget."""
    clouds = []
    for key in dict.fromkeys((r["material"], r["paths"]) for r in rows):
        part = [r for r in rows if (r["material"], r["paths"]) == key]
        clouds.append(
            Cloud(
                f"{key[0]}, {key[1] / 1e6:g} M paths",
                [r["spp"] for r in part],
                [r["unexplained"]["value"] or math.nan for r in part],
                [0.0] * len(part),
                [r["unexplained"]["error"] or 0.0 for r in part],
                [""] * len(part),
            )
        )
    scatter(clouds, "paths per query", "unexplained variance of test queries", "query split", png=path)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("materials", nargs="*", type=Path)
    parser.add_argument("--paths", type=float, action="append", help="budget of paths; repeatable")
    parser.add_argument("--spp", type=int, action="append", help="paths per query; repeatable")
    parser.add_argument("--time", default="15s", help="training time of each fit")
    parser.add_argument("--levels", type=int, default=6)
    parser.add_argument("--height", type=float, help="factor on the stored heights")
    parser.add_argument("--plot", type=Path, help="PNG of the table")
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    try:
        parse_duration(arguments.time)
        for material in arguments.materials or [ROOT / "assets" / name for name in ASSETS]:
            rows += measure(
                material,
                arguments.height,
                arguments.levels,
                arguments.paths or PATHS,
                arguments.spp or SPP,
                arguments.time,
            )
    except (MbtfError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code if isinstance(error, MbtfError) else 2
    if arguments.plot is not None:
        plot(rows, arguments.plot)
    print(json.dumps({"figures": rows, "least_error_at": best(rows), "bars": {}, "met": None}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
