"""Total times split between generating and training: fixed shares, and the share of ``run --time``.

    python benchmarks/time_split.py [MATERIAL ...] [--time 5min] [--share 0.2 ...] [--resolution 128]

Each run generates for its share of the time and trains `neumip` with the options of the presets for the rest,
start-up, loading and evaluation included. All runs are evaluated on the same test set. ``run --time`` pays
for its own pilots. By default two of ``assets/``, five minutes (long enough for pilots) and shares of 10 to
70 %.

The last line is one JSON object with the figures and their threshold: the error under ``run --time`` over the
lowest error of the fixed shares is at most 1.2, within one error bar. Exit code 1 where it is exceeded.
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
from mbtf_pipeline.cost_study.runs import DataRequest, Run, RunRunner
from mbtf_pipeline.cost_study.time_split import split_time, with_split
from mbtf_pipeline.recipe import Recipe

ROOT = Path(__file__).resolve().parents[1]
ASSETS = ("turtle_shell", "cliff_rock")
SHARES = (0.1, 0.2, 0.35, 0.5, 0.7)
THRESHOLD = 1.2
# Share of the time that runs train for, about: it decides the size of their network.
TRAINING = 0.5


def measure(
    material: Path, seconds: float, shares: list[float], resolution: int, work: Path
) -> dict[str, Any]:
    """Errors of the fixed shares and of ``run --time``."""
    generate = {"material": str(material), "queries": {"resolution": resolution, "test_spp": 16}}
    fit = nested({"model": "neumip", **best_options(TRAINING * seconds)})
    recipe = Recipe.model_validate({"name": "time", "generate": generate, "fit": fit})

    def note(text: str) -> None:
        print(f"{material.name}: {text}", file=sys.stderr)

    runner = RunRunner(recipe.generate, work / "runs", "", lambda text: None)
    rows, errors = [], []
    for share in [*shares, None]:
        split = split_time(recipe, seconds, work / f"run-{share}", "", note, share)
        note(split.describe())
        pilots = split.pilot_seconds if share is None else 0.0
        data = DataRequest(split.queries, recipe.generate.queries.spp)
        options = with_split(recipe, split).fit["neumip"].fields()
        found = runner.measure(Run("whole", "neumip", f"{split.share:.0%}", data, options))
        runner.forget(data)
        errors.append(found.error)
        rows.append(
            {
                "share": split.share,
                "pilots": share is None,
                "queries": split.queries,
                "seconds": round(found.details["total_seconds"] + pilots, 1),
                "unexplained": found.error.as_dict(),
            }
        )
        note(json.dumps(rows[-1]))
    runner.clear()
    best = min(errors[:-1], key=lambda e: e.value)
    ratio = errors[-1].value / best.value
    error = ratio * math.hypot(best.relative_error, errors[-1].relative_error)
    return {"material": material.name, "rows": rows, "ratio": ratio, "ratio_error": error}


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("materials", nargs="*", type=Path)
    parser.add_argument("--time", default="5min", help="total time of a run")
    parser.add_argument("--share", action="append", type=float, help="share that generates (repeatable)")
    parser.add_argument("--resolution", type=int, default=128, help="texels across at the finest level")
    arguments = parser.parse_args()
    found = []
    try:
        load_mitsuba()
        seconds = parse_duration(arguments.time)
        for material in arguments.materials or [ROOT / "assets" / name for name in ASSETS]:
            with tempfile.TemporaryDirectory() as work:
                shares = arguments.share or list(SHARES)
                found.append(measure(material, seconds, shares, arguments.resolution, Path(work)))
    except (MbtfError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 3
    for one in found:
        print(f"{one['material']:16s} run --time over the best fixed share: {one['ratio']:.2f}")
    met = all(one["ratio"] - one["ratio_error"] <= THRESHOLD for one in found)
    print(json.dumps({"figures": found, "thresholds": {"ratio": THRESHOLD}, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
