"""Forecasts held against the runs that follow: seconds and error of the generator and of the fitter.

    python benchmarks/forecasts.py [MATERIAL ...] [--queries 200/texel] [--levels 7] [--time 60s]

Of every material (by default the five of ``assets/``): what ``mbtf-gen plan`` and ``mbtf-fit --dry-run``
expect, then the run itself. Seconds are those of tracing and of training; errors are the noise of a training
value and the unexplained variance of held-out queries.

The last line is one JSON object: figures, and the bars they are held to: seconds within 30 %, errors within a
factor 1.5. Exit code 1 where one is missed.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from mbtf_gen.config import GeneratorConfig
from mbtf_gen.engine import load_mitsuba
from mbtf_gen.errors import MbtfError

ROOT = Path(__file__).resolve().parents[1]
ASSETS = ("cliff_rock", "insulation_foam", "straight_wool", "turtle_shell", "twisted_wool")
# Largest factors between forecast and run, either way.
BARS = {"seconds": 1.3, "error": 1.5}


def generated(material: Path, queries: str, levels: int, shards: Path) -> dict[str, float]:
    """Forecast and run of the generator."""
    from mbtf_gen.forecast import forecast
    from mbtf_gen.generation import Job, allocated, generate
    from mbtf_gen.planning import plan_effects

    config = GeneratorConfig.model_validate(
        {"material": str(material), "queries": {"train": queries, "levels": levels}}
    )
    job = Job.prepare(config)
    expected = forecast(job, allocated(job, plan_effects(job)))
    start = time.perf_counter()
    summary = generate(config, shards, job=job)
    took = time.perf_counter() - start
    return {
        "seconds, forecast": expected.seconds + expected.start,
        "seconds": took,
        "error, forecast": expected.relative_error,
        "error": summary.relative_error,
    }


def fitted(shards: Path, seconds: str, out: Path) -> dict[str, float]:
    """Forecast and run of the fitter."""
    from mbtf_fit import fit
    from mbtf_fit.config import FitConfig
    from mbtf_fit.forecast import forecast_fit

    config = FitConfig.model_validate({"training": {"time": seconds}})
    expected = forecast_fit(config, shards)
    # As long as the forecast's own steps take, so that its rate is what is judged.
    run = FitConfig.model_validate({"training": {"steps": expected.steps}})
    result = fit(run, shards, out)
    return {
        "seconds, forecast": expected.seconds,
        "seconds": result.seconds,
        "error, forecast": expected.unexplained if expected.unexplained is not None else math.nan,
        "error": result.errors["held_out_queries"]["unexplained"]["value"],
    }


def factor(a: float, b: float) -> float:
    """How far apart two positive numbers are, at least 1."""
    return max(a / b, b / a) if min(a, b) > 0 else math.inf


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("materials", nargs="*", type=Path)
    parser.add_argument("--queries", default="200/texel")
    parser.add_argument("--levels", type=int, default=7, help="finest level: 2^levels texels")
    parser.add_argument("--time", default="60s", help="training")
    arguments = parser.parse_args()
    figures: dict[str, Any] = {}
    try:
        load_mitsuba()
        for material in arguments.materials or [ROOT / "assets" / name for name in ASSETS]:
            with tempfile.TemporaryDirectory() as work:
                shards, out = Path(work) / "shards", Path(work) / "material"
                parts = {
                    "generator": generated(material, arguments.queries, arguments.levels, shards),
                    "fitter": fitted(shards, arguments.time, out),
                }
            for part, found in parts.items():
                for what in ("seconds", "error"):
                    found[f"{what}, factor"] = factor(found[what], found[f"{what}, forecast"])
                print(
                    f"{material.name:16s} {part:9s}  "
                    f"{found['seconds']:6.1f} s (forecast {found['seconds, forecast']:6.1f})  "
                    f"error {found['error']:.3f} (forecast {found['error, forecast']:.3f})",
                    flush=True,
                )
            figures[material.name] = parts
    except MbtfError as error:
        print(f"error: {error.message}", file=sys.stderr)
        return error.exit_code
    met = all(
        found[f"{what}, factor"] <= bar
        for parts in figures.values()
        for found in parts.values()
        for what, bar in BARS.items()
    )
    print(json.dumps({"figures": figures, "bars": BARS, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
