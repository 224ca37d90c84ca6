"""Splits of a total time between generating and training: fixed ones, and the one that ``--budget`` finds.

    python benchmarks/budget.py [MATERIAL ...] [--time 5min] [--split 0.2 ...] [--resolution 128]

Every chain generates for its share of the time and trains ``neumip``, as the qualities have it, for the rest,
start-up, loading and judging included, and is judged by the same test queries. ``--budget`` pays for its own
pilots: what they take is missing from its chain. By default two of ``assets/``, five minutes (long enough for
pilots) and splits of 10 to 70 %.

The last line is one JSON object: figures, and the bar they are held to: the error under ``--budget`` over the
least of the grid is at most 1.2, or no more than its error bar allows. Exit code 1 where it is missed.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from pathlib import Path
from typing import Any

from mbtf_core.config_file import nested
from mbtf_core.errors import MbtfError
from mbtf_core.units import parse_duration
from mbtf_fit.presets import best_options
from mbtf_gen.render.runtime import load_mitsuba
from mbtf_pipeline.cost_study.runs import Chain, RunRequest, RunRunner
from mbtf_pipeline.cost_study.time_split import Split, split_budget, within_budget
from mbtf_pipeline.recipe import Recipe

ROOT = Path(__file__).resolve().parents[1]
ASSETS = ("turtle_shell", "cliff_rock")
SPLITS = (0.1, 0.2, 0.35, 0.5, 0.7)
TEST, TEST_SPP = "131072", 16
BAR = 1.2
# Share of the time that chains train for, about: what their network follows.
TRAINING = 0.5


def chain(recipe: Recipe, split: Split) -> Chain:
    """The chain that a split makes of a recipe."""
    spent = within_budget(recipe, split)
    fit = spent.fit["neumip"].fields()
    data = RunRequest(split.queries, recipe.generate.queries.spp)
    return Chain("chain", "neumip", f"{split.share:.0%}", data, fit)


def measure(material: Path, seconds: float, splits: list[float], levels: int, work: Path) -> dict[str, Any]:
    """Errors of the grid and of ``--budget``."""
    recipe = Recipe.model_validate(
        {
            "name": "budget",
            "generate": {
                "material": str(material),
                "queries": {"resolution": 1 << levels, "test": TEST, "test_spp": TEST_SPP},
            },
            "fit": nested({"model": "neumip", **best_options(TRAINING * seconds)}),
        }
    )
    found = split_budget(recipe, seconds, work / "run", "", lambda note: print(note, file=sys.stderr))
    print(f"{material.name}: {found.describe()}", file=sys.stderr)
    workshop = RunRunner(recipe.generate, work / "chains", "", lambda note: None)
    rows, errors = [], []
    for share in [*splits, None]:
        split = found
        if share is not None:
            # By the same prices, but for pilots.
            queries, generating, training = found.prices.spend(seconds, share)
            split = Split(int(queries), generating, training, share, (), 0.0, found.prices)
        point = workshop.measure(chain(recipe, split))
        workshop.forget(RunRequest(split.queries, recipe.generate.queries.spp))
        took = point.details["total_seconds"] + (found.pilot_seconds if share is None else 0.0)
        errors.append(point.error)
        rows.append(
            {
                "split": "--budget" if share is None else share,
                "share": split.share,
                "queries": split.queries,
                "seconds": round(took, 1),
                "unexplained": point.error.value,
                "error": point.error.error,
            }
        )
        print(f"{material.name:16s} {json.dumps(rows[-1])}", file=sys.stderr, flush=True)
    workshop.clear()
    best = min(errors[:-1], key=lambda e: e.value)
    ratio = errors[-1].value / best.value
    spread = ratio * math.hypot(best.relative_error, errors[-1].relative_error)
    return {"material": material.name, "rows": rows, "ratio": ratio, "ratio_error": spread}


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("materials", nargs="*", type=Path)
    parser.add_argument("--time", default="5min", help="total time of a chain")
    parser.add_argument("--split", action="append", type=float, help="share that generates (repeatable)")
    parser.add_argument("--resolution", type=int, default=128, help="texels across, a power of two")
    arguments = parser.parse_args()
    materials = arguments.materials or [ROOT / "assets" / name for name in ASSETS]
    found = []
    try:
        load_mitsuba()
        seconds = parse_duration(arguments.time)
        for material in materials:
            with tempfile.TemporaryDirectory() as work:
                found.append(
                    measure(
                        material,
                        seconds,
                        arguments.split or list(SPLITS),
                        arguments.resolution.bit_length() - 1,
                        Path(work),
                    )
                )
    except (MbtfError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 3
    for one in found:
        print(f"{one['material']:16s} --budget over the best fixed split: {one['ratio']:.2f}")
    met = all(one["ratio"] - one["ratio_error"] <= BAR for one in found)
    print(json.dumps({"figures": found, "bars": {"ratio": BAR}, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
