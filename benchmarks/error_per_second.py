"""Mean squared error at equal time, beside plain independent sampling of the same paths.

    python benchmarks/error_per_second.py [--materials DIR] [--queries 65536] [--spp 16] [--repeats 4]

Random queries of the default mixture of levels on three texture sets, 16 paths per query on average. All
sides trace the same paths with the same kernel and limits:

- **plain**: independent random numbers, every query the same number of paths;
- **points**: low-discrepancy points;
- **all**: low-discrepancy points, and more paths where a pilot expects more noise (the pilot, once per data
  set, is timed apart);
- **late roulette**: *plain* and *all* with Russian roulette from the third interaction on, surviving with the
  throughput, as renderers have it.

Each ratio is mean variance times processor seconds (of all threads, so that other work on the machine does
not count) of *plain* over the same of another side, from one run in which the sides alternate: variance from
the two halves, error bars from the scatter over repeats. The last line is one JSON object: figures, and the
bars that they are held to. Exit code 1 where a bar is missed.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import MbtfError
from mbtf_core.stats.groups import level_groups
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.engine.runtime import load_mitsuba
from mbtf_gen.job import Job
from mbtf_gen.planning.effects_planner import reference_plan
from mbtf_gen.planning.sample_allocation import measure_allocation
from mbtf_gen.planning.simulation import build_estimator
from mbtf_gen.render.estimates import Estimates, Stream

ROOT = Path(__file__).resolve().parents[1]
# Texture sets and the factor on their heights.
MATERIALS = {"rock_cliff": 0.12, "knit_fabric": 0.05, "metal_plate": 0.05}
LEVELS = 7
MESH = 256
# Interactions before roulette where it comes late.
LATE = 3
# Geometric mean over the sets of the ratio at equal time.
BARS = {"geometric_mean": 2.0}


def independent_points(sequence: Callable[..., Any]) -> Callable[..., Any]:
    """Every path the first point of a sequence of its own, in place of the points of one: independent random
    numbers at the same cost."""

    def plain(key: Any, salt: Any, query: Any, index: Any) -> Any:
        return sequence(key, salt, query * 65536 + index, index * 0)

    return plain


def sides(job: Job, count: int, spp: int) -> tuple[dict[str, Callable[[int], Estimates]], float, Any]:
    """(what to run by name, seconds of the pilot, the queries)."""
    import mbtf_gen.render.estimator as module
    from mbtf_gen.render import path_tracer as tracing

    plan = reference_plan(job)
    estimator = build_estimator(job, plan)
    queries = job.query_plan.draw("train", 0, count)
    start = time.process_time()
    allocation = measure_allocation(job, plan)
    pilot = time.process_time() - start
    counts = allocation.counts(queries, spp)
    low_discrepancy = module.sequence
    independent = independent_points(low_discrepancy)
    survival, usual = tracing.SURVIVAL_PER_THROUGHPUT, estimator.transport

    def side(sequence: Any, each: NDArray[np.int64] | None, late: bool) -> Callable[[int], Estimates]:
        def run(repeat: int) -> Estimates:
            stream = Stream(1, "train", repeat)
            module.sequence = sequence
            if late:
                tracing.SURVIVAL_PER_THROUGHPUT = 1.0
            estimator.transport = replace(usual, roulette_depth=LATE if late else usual.roulette_depth)
            try:
                found: Estimates = estimator.estimate(queries, spp if each is None else each, stream)
                return found
            finally:
                module.sequence, tracing.SURVIVAL_PER_THROUGHPUT = low_discrepancy, survival

        return run

    found = {
        "plain": side(independent, None, False),
        "points": side(low_discrepancy, None, False),
        "all": side(low_discrepancy, counts, False),
        "plain, late roulette": side(independent, None, True),
        "all, late roulette": side(low_discrepancy, counts, True),
    }
    return found, pilot, queries


def measure(name: str, folder: Path, height: float, arguments: argparse.Namespace) -> dict[str, Any]:
    """Ratios of one texture set."""
    config = GeneratorConfig.model_validate(
        {
            "material": str(folder / name),
            "geometry": {"height_scale": height, "mesh": MESH},
            "queries": {"resolution": 1 << LEVELS},
        }
    )
    runs, pilot, queries = sides(Job.prepare(config), arguments.queries, arguments.spp)
    labels = level_groups(queries.sigma, LEVELS)
    variance: dict[str, list[NDArray[np.float64]]] = {side: [] for side in runs}
    seconds: dict[str, list[float]] = {side: [] for side in runs}
    paths: dict[str, int] = {}
    for repeat in range(-1, arguments.repeats):
        for side, run in runs.items():
            start = time.process_time()
            found = run(repeat + 1)
            took = time.process_time() - start
            if repeat < 0:
                continue
            difference = found.value_a.astype(np.float64) - found.value_b
            variance[side].append(np.mean(0.25 * difference**2, axis=-1))
            seconds[side].append(took)
            paths[side] = found.paths

    def ratio(side: str, rows: NDArray[np.bool_] | slice, timed: bool = True) -> list[float]:
        """(ratio, its standard error from the scatter over repeats)."""
        if side == "plain":
            return [1.0, 0.0]
        both = [
            np.array([v[rows].mean() for v in variance[s]]) * (np.median(seconds[s]) if timed else 1.0)
            for s in ("plain", side)
        ]
        value = both[0].mean() / both[1].mean()
        spread = [x.std(ddof=1) / x.mean() / np.sqrt(len(x)) for x in both]
        return [round(float(value), 3), round(float(value * np.hypot(*spread)), 3)]

    out: dict[str, Any] = {"pilot_processor_seconds": round(pilot, 2), "sides": {}}
    for side in runs:
        rate = paths[side] / float(np.median(seconds[side])) / 1e6
        out["sides"][side] = {
            "million_paths_per_processor_second": round(rate, 3),
            "mean_variance": float(np.mean([v.mean() for v in variance[side]])),
            "equal_time": ratio(side, slice(None)),
            "equal_paths": ratio(side, slice(None), timed=False),
        }
        value, error = out["sides"][side]["equal_time"]
        print(
            f"{name:12s} {side:22s} {rate:5.2f} M paths/CPU s  {value:5.2f} ± {error:.2f} in equal time",
            file=sys.stderr,
        )
    out["levels"] = {str(level): ratio("all", labels == level) for level in np.unique(labels)}
    return out


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--materials", type=Path, default=ROOT.parent / "shared" / "data" / "materials")
    parser.add_argument("--queries", type=int, default=1 << 16, help="queries per run")
    parser.add_argument("--spp", type=int, default=16, help="mean number of paths per query (even)")
    parser.add_argument(
        "--repeats", type=int, default=4, help="timed runs of each side, with other random numbers"
    )
    parser.add_argument("--only", help="one texture set")
    arguments = parser.parse_args()
    chosen = {n: h for n, h in MATERIALS.items() if arguments.only in (None, n)}
    try:
        load_mitsuba()
        figures = {name: measure(name, arguments.materials, h, arguments) for name, h in chosen.items()}
    except MbtfError as error:
        print(f"error: {error.message}", file=sys.stderr)
        return error.exit_code
    mean = float(np.exp(np.mean([np.log(f["sides"]["all"]["equal_time"][0]) for f in figures.values()])))
    for name, found in figures.items():
        value, spread = found["sides"]["all"]["equal_time"]
        levels = "  ".join(f"{level}: {r[0]:.2f}" for level, r in found["levels"].items())
        print(f"{name:12s} {value:.2f} ± {spread:.2f}   by level  {levels}")
    met = mean >= BARS["geometric_mean"]
    print(json.dumps({"figures": figures, "geometric_mean": round(mean, 3), "bars": BARS, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
