"""Forecasts compared with the runs that follow: seconds and error of the generator and of the fitter.

    python benchmarks/forecasts.py [MATERIAL ...] [--quality draft] [--resolution 128] [--time 60s ...]

For every material (by default the five of ``assets/`` and the six texture sets that lie beside the project):
the forecasts of ``mbtf-gen plan`` and ``mbtf-fit --dry-run`` at a preset, then the run itself, with a fit for
each ``--time`` (repeatable). Seconds are those of tracing and of training. Errors are the noise of a training
value and the unexplained variance of test queries. Also prints the `PERSISTENCE` of
``mbtf_fit/training/forecast.py`` that suits all of these fits best.

The last line is one JSON object with the figures and their thresholds: seconds within 30 %, errors within a
factor 1.5. Exit code 1 where one is exceeded.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, get_args

import numpy as np
from quality import HEIGHT_SCALES, generator_config, source

from mbtf_core.config_file import resolve
from mbtf_core.errors import MbtfError
from mbtf_core.units import parse_duration
from mbtf_fit.config import FitConfig
from mbtf_fit.presets import best_options
from mbtf_fit.training.forecast import PERSISTENCE, PILOT_SECONDS, extrapolated
from mbtf_gen.config.presets import Quality, as_assignments
from mbtf_gen.engine.runtime import load_mitsuba

ASSETS = ("cliff_rock", "insulation_foam", "straight_wool", "turtle_shell", "twisted_wool")
# Largest factors between forecast and run, either way.
THRESHOLDS = {"seconds": 1.3, "error": 1.5}


def generated(name: str, quality: Quality, resolution: int, shards: Path) -> dict[str, Any]:
    """Forecast and run of the generator."""
    from mbtf_gen.forecast import forecast
    from mbtf_gen.generation import generate
    from mbtf_gen.job import Job
    from mbtf_gen.planning.effects_planner import plan_effects
    from mbtf_gen.planning.run_plan import allocate

    config = generator_config(name, quality, resolution)
    job = Job.prepare(config)
    expected = forecast(job, allocate(job, plan_effects(job)))
    start = time.perf_counter()
    summary = generate(job, shards)
    took = time.perf_counter() - start
    return {
        "seconds, forecast": expected.seconds + expected.start,
        "seconds": took,
        "error, forecast": expected.relative_error,
        "error": summary.relative_error,
    }


def fitted(shards: Path, seconds: str, out: Path) -> dict[str, Any]:
    """Forecast and run of the fitter."""
    from mbtf_fit import fit
    from mbtf_fit.training.forecast import forecast_fit

    options = {**best_options(parse_duration(seconds)), "training.time": seconds, "training.steps": None}
    config = resolve(FitConfig, assignments=as_assignments(options))
    expected = forecast_fit(config, shards)
    # As many steps as forecast, so that the seconds compare the forecast rate.
    run = resolve(FitConfig, assignments=as_assignments({**options, "training.steps": expected.steps}))
    result = fit(run, shards, out)
    reached = result.errors["test"]["unexplained"]
    return {
        "seconds, forecast": expected.seconds,
        "seconds": result.seconds,
        "error, forecast": expected.unexplained if expected.unexplained is not None else math.nan,
        "error": math.nan if reached["value"] is None else reached["value"],
        "error, se": reached["error"],
        "pilots": expected.pilots,
    }


def factor(a: float, b: float) -> float:
    """Ratio of two positive numbers, at least 1; infinite where one is not positive or unknown."""
    return max(a / b, b / a) if a > 0 and b > 0 else math.inf


def best_persistence(fits: list[dict[str, Any]]) -> tuple[float, float]:
    """(persistence, root mean square of the logarithm of forecast over reached with it)."""

    def missed(persistence: float) -> float:
        squares = []
        for found in fits:
            doublings = math.log2(found["seconds, forecast"] / PILOT_SECONDS[1])
            short, long = found["pilots"]
            forecast = extrapolated(short, long, doublings, persistence=persistence)
            squares.append(math.log(forecast / found["error"]) ** 2)
        return math.sqrt(sum(squares) / len(squares))

    tried = [float(p) for p in np.arange(0.3, 0.99, 0.01)]
    best = min(tried, key=missed)
    return round(best, 2), missed(best)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("materials", nargs="*", help="names of assets or texture sets")
    parser.add_argument("--quality", default="draft", choices=get_args(Quality))
    parser.add_argument("--resolution", type=int, default=128, help="texels across, a power of two")
    parser.add_argument("--time", action="append", help="training (repeatable); default: 60s")
    arguments = parser.parse_args()
    figures: dict[str, Any] = {}
    fits: list[dict[str, Any]] = []
    try:
        load_mitsuba()
        for name in arguments.materials or [*ASSETS, *HEIGHT_SCALES]:
            if not source(name)[0].is_dir():
                print(f"{name}: skipped, {source(name)[0]} is missing", file=sys.stderr)
                continue
            with tempfile.TemporaryDirectory() as work:
                shards = Path(work) / "shards"
                parts = {"generator": generated(name, arguments.quality, arguments.resolution, shards)}
                for seconds in arguments.time or ["60s"]:
                    label = f"fitter {parse_duration(seconds):g} s"
                    parts[label] = fitted(shards, seconds, Path(work) / seconds)
                    if len(parts[label]["pilots"]) == 2 and min(*parts[label]["pilots"]) > 0:
                        fits.append(parts[label])
            for part, found in parts.items():
                for what in ("seconds", "error"):
                    found[f"{what}, factor"] = factor(found[what], found[f"{what}, forecast"])
                pilots = "".join(f" {e:.3f}" for e in found.get("pilots", ()))
                print(
                    f"{name:16s} {part:14s}  "
                    f"{found['seconds']:6.1f} s (forecast {found['seconds, forecast']:6.1f})  "
                    f"error {found['error']:.3f} (forecast {found['error, forecast']:.3f}"
                    f"{', pilots' + pilots if pilots else ''})",
                    flush=True,
                )
            figures[name] = parts
    except (MbtfError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code if isinstance(error, MbtfError) else 2
    rows = [found for parts in figures.values() for found in parts.values()]
    met = all(
        found[f"{what}, factor"] <= threshold for found in rows for what, threshold in THRESHOLDS.items()
    )
    persistence = best_persistence([f for f in fits if f["error"] > 0]) if fits else None
    if persistence is not None:
        print(
            f"persistence: {persistence[0]} fits these best, a factor {math.exp(persistence[1]):.2f} (RMS); "
            f"the code has {PERSISTENCE}"
        )
    print(json.dumps({"figures": figures, "persistence": persistence, "thresholds": THRESHOLDS, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
