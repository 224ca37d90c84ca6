"""Many noisy queries or few clean ones? Test error of a fit at equal total paths.

    python benchmarks/query_split.py [MATERIAL ...] [--paths 1.6e6 --paths 6.4e6] [--spp 2 ...] [--steps N]
                                     [--resolution 64] [--height-scale H] [--keep FILE] [--plot FILE]

For every material (by default three of ``assets/``), total of paths and number of paths per query, a data set
is generated and ``neumip`` is trained on it for the same number of steps. All fits are evaluated on the same
test queries. No figure depends on the machine's speed. At 64² texels the larger of the default totals is that
of the preset ``draft``. Prints the unexplained variance, and for each total the number of paths per query
with the lowest one. ``--keep FILE`` stores every measurement, so that the same command resumes.

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

from mbtf_core.errors import MbtfError
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_pipeline.cost.measurements import SCHEMA
from mbtf_pipeline.cost.runs import DataRequest, Run, RunRunner
from mbtf_pipeline.report.plots import Cloud, scatter

ROOT = Path(__file__).resolve().parents[1]
ASSETS = ("cliff_rock", "straight_wool", "turtle_shell")
SPP = (2, 4, 8, 16, 64, 256)
PATHS = (1.6e6, 6.4e6)
# What identifies a measurement.
KEY = ("material", "height_scale", "resolution", "steps", "paths", "spp", "schema")


class Kept:
    """Measurements, one JSON object per line of a file; not stored without one."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        lines = path.read_text().splitlines() if path is not None and path.exists() else []
        self._rows = {self._key(row): row for row in map(json.loads, lines)}

    @staticmethod
    def _key(row: dict[str, Any]) -> tuple[Any, ...]:
        return tuple(row.get(name) for name in KEY)

    def find(self, row: dict[str, Any]) -> dict[str, Any] | None:
        """The stored measurement of a key."""
        return self._rows.get(self._key(row))

    def add(self, row: dict[str, Any]) -> None:
        """Store a measurement."""
        self._rows[self._key(row)] = row
        if self._path is not None:
            with self._path.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(row) + "\n")


def measure(
    material: Path,
    height_scale: float | None,
    resolution: int,
    totals: Sequence[float],
    spps: Sequence[int],
    steps: int,
    kept: Kept,
) -> list[dict[str, Any]]:
    """One row per total and number of paths per query."""
    geometry = {} if height_scale is None else {"height_scale": height_scale}
    config = GeneratorConfig.model_validate(
        {"material": str(material), "geometry": geometry, "queries": {"resolution": resolution}}
    )
    rows = []
    fit = {"model": "neumip", "training": {"steps": steps}}
    with tempfile.TemporaryDirectory() as work:
        runner = RunRunner(
            config, Path(work), "", lambda note: print(f"{material.name}: {note}", file=sys.stderr)
        )
        for total in totals:
            for spp in spps:
                values = (material.name, height_scale, resolution, steps, int(total), spp, SCHEMA)
                key = dict(zip(KEY, values, strict=True))
                row = kept.find(key)
                if row is None:
                    data = DataRequest(max(1, int(total) // spp), spp)
                    found = runner.measure(Run("data", f"{total:g} paths", f"{spp}", data, fit))
                    runner.forget(data)
                    row = {**key, "queries": data.queries, "unexplained": found.error.as_dict()}
                    kept.add(row)
                rows.append(row)
                left = row["unexplained"]
                print(
                    f"{material.name:16s} {total / 1e6:6.1f} M paths  {spp:4d} per query  "
                    f"{left['value']:.4f} ± {left['error']:.4f}",
                    flush=True,
                )
    return rows


def best(rows: Sequence[dict[str, Any]]) -> dict[str, int]:
    """Number of paths per query with the lowest error, by material and total paths."""
    found: dict[str, dict[str, Any]] = {}
    for row in rows:
        key = f"{row['material']} {row['paths'] / 1e6:g}M"
        value = row["unexplained"]["value"]
        if value is not None and (key not in found or value < found[key]["unexplained"]["value"]):
            found[key] = row
    return {key: row["spp"] for key, row in found.items()}


def plot(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Unexplained variance over paths per query, a line per material and total paths."""
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
    parser.add_argument("--paths", type=float, action="append", help="total of paths; repeatable")
    parser.add_argument("--spp", type=int, action="append", help="paths per query; repeatable")
    parser.add_argument("--steps", type=int, default=400, help="training steps of each fit")
    parser.add_argument("--resolution", type=int, default=64, help="texels across at the finest level")
    parser.add_argument("--height-scale", type=float, help="factor on the stored heights")
    parser.add_argument("--keep", type=Path, help="file of stored measurements, to resume")
    parser.add_argument("--plot", type=Path, help="PNG of the table")
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    try:
        kept = Kept(arguments.keep)
        for material in arguments.materials or [ROOT / "assets" / name for name in ASSETS]:
            rows += measure(
                material,
                arguments.height_scale,
                arguments.resolution,
                arguments.paths or PATHS,
                arguments.spp or SPP,
                arguments.steps,
                kept,
            )
    except (MbtfError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code if isinstance(error, MbtfError) else 2
    if arguments.plot is not None:
        plot(rows, arguments.plot)
    print(json.dumps({"figures": rows, "least_error_at": best(rows), "thresholds": {}, "met": None}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
