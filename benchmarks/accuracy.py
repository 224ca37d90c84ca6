"""Accuracy of the generator's values: error at equal time, and runs with a target error.

    python benchmarks/accuracy.py [equal-time [NAME ...]] [--queries 65536] [--spp 16] [--repeats 4]
    python benchmarks/accuracy.py target [MATERIAL ...] [--target 0.05] [--queries 1500] [--max-spp N]

``equal-time`` compares with plain independent sampling on three texture sets. All ways trace the same paths
with the same kernel:

- **plain**: independent random numbers, every query the same number of paths;
- **points**: low-discrepancy points;
- **all**: low-discrepancy points, and more paths where a pilot expects more noise;
- **late roulette**: *plain* and *all* with Russian roulette from the third interaction on, surviving with the
  throughput, as renderers have it.

Each ratio is mean variance times processor seconds of *plain* over the same of another way; error bars come
from the scatter over repeats.

``target`` compares runs with a target error with the true noise of every query, from 6144 paths of its own:
root mean squares of true standard error, actual error and reported error, over the target; paths per query,
pilots included, and how many would do if the variances were known; and the bias in standard errors (z).

The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from common import ASSETS, finish, is_available, parser_of, source, start
from numpy.typing import NDArray

from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.engine.runtime import load_mitsuba
from mbtf_gen.planning.adaptive import estimate_shard, round_up
from mbtf_gen.planning.job import Job
from mbtf_gen.planning.run_plan import plan_run, reference_plan
from mbtf_gen.planning.sample_allocation import measure_allocation
from mbtf_gen.planning.simulation import build_estimator
from mbtf_gen.render.estimates import Estimates, Stream, Target

TEXTURES = ("rock_cliff", "knit_fabric", "metal_plate")
RESOLUTION = 128
MESH = 256
# Interactions before roulette where it comes late.
LATE = 3
# Geometric mean over the sets of the ratio at equal time.
LEAST = {"geometric_mean": 2.0}
POLISHED = "height: {height}\nroughness: 0.2\nmetallic: 1.0\n"
# Against chance: one run in ten thousand.
MOST = {"largest |z|": 4.0}
TRUTHS, TRUTH_PATHS = 6, 1024
F64 = NDArray[np.float64]


def independent_points(sequence: Callable[..., Any]) -> Callable[..., Any]:
    """Every path the first point of a sequence of its own, in place of the points of one: independent random
    numbers at the same cost."""

    def plain(key: Any, salt: Any, query: Any, index: Any) -> Any:
        return sequence(key, salt, query * 65536 + index, index * 0)

    return plain


def sides(job: Job, count: int, spp: int) -> tuple[dict[str, Callable[[int], Estimates]], float]:
    """(what to run by name, seconds of the pilot)."""
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
    return found, pilot


def measure_ratios(name: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Ratios of one texture set."""
    material, height = source(name)
    config = GeneratorConfig.model_validate(
        {
            "material": str(material),
            "geometry": {"height_scale": height, "mesh": MESH},
            "queries": {"resolution": RESOLUTION},
        }
    )
    runs, pilot = sides(Job.load(config), arguments.queries, arguments.spp)
    variance: dict[str, list[float]] = {side: [] for side in runs}
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
            variance[side].append(float(np.mean(0.25 * difference**2)))
            seconds[side].append(took)
            paths[side] = found.paths

    def ratio(side: str) -> list[float]:
        """(ratio, its standard error from the scatter over repeats)."""
        if side == "plain":
            return [1.0, 0.0]
        both = [np.array(variance[s]) * np.median(seconds[s]) for s in ("plain", side)]
        value = both[0].mean() / both[1].mean()
        spread = [x.std(ddof=1) / x.mean() / np.sqrt(len(x)) for x in both]
        return [round(float(value), 3), round(float(value * np.hypot(*spread)), 3)]

    out: dict[str, Any] = {"pilot_processor_seconds": round(pilot, 2), "sides": {}}
    for side in runs:
        rate = paths[side] / float(np.median(seconds[side])) / 1e6
        out["sides"][side] = {
            "million_paths_per_processor_second": round(rate, 3),
            "mean_variance": float(np.mean(variance[side])),
            "equal_time": ratio(side),
        }
        value, error = out["sides"][side]["equal_time"]
        print(f"{name:12s} {side:22s} {rate:5.2f} M paths/CPU s  {value:5.2f} ± {error:.2f} in equal time")
    return out


def measure_target(
    material: Path, name: str, height: float | None, error: float, cap: int, n: int
) -> dict[str, Any]:
    """Figures of a run with a target error on one material."""
    queries = {
        "resolution": RESOLUTION,
        "train": str(n),
        "test": "2",
        "test_spp": 2,
        "target_error": error,
        "max_spp": cap,
    }
    config = GeneratorConfig.model_validate(
        {"material": str(material), "geometry": {"height_scale": height}, "queries": queries}
    )
    job = Job.load(config)
    plan = plan_run(job)
    estimator, q = build_estimator(job, plan.effects), job.query_plan.draw("train", 0, n)
    assert plan.allocation is not None
    tile_mean = plan.allocation.tile_mean(q)
    found = estimate_shard(estimator, q, 4, Target(error, cap), Stream(0, "train", 0), plan.allocation)
    assert found.spp is not None
    assert found.target is not None
    means, variances = [], []
    for part in range(TRUTHS):
        e = estimator.estimate(q, TRUTH_PATHS, Stream(1, "train", part), path_variance=True)
        means.append(e.value_a.astype(np.float64).mean(axis=1) / 2 + e.value_b.mean(axis=1) / 2)
        variances.append(e.path_variance.astype(np.float64))
    truth: F64 = np.mean(means, axis=0)
    variance: F64 = np.mean(variances, axis=0)
    scale = np.maximum(truth, tile_mean)
    true_error = np.sqrt(variance / found.spp) / scale
    value = 0.5 * (found.value_a.astype(np.float64) + found.value_b).mean(axis=1)
    # Two independent truths: their own noise cancels.
    first, second = np.mean(means[::2], axis=0), np.mean(means[1::2], axis=0)
    actual = float(np.mean((value - first) * (value - second) / scale**2))
    difference = (value - truth) / scale
    known = round_up(variance / (error * scale) ** 2, cap)
    return {
        "material": name,
        "target": error,
        "standard_error": float(np.sqrt(np.mean(true_error**2))) / error,
        "actual_error": math.sqrt(max(actual, 0.0)) / error,
        "reached": math.sqrt(found.target.square) / error,
        "paths": found.paths / n,
        "paths_if_known": float(known.mean()),
        "z": float(difference.mean() / (difference.std(ddof=1) / math.sqrt(n))),
    }


def equal_time(arguments: argparse.Namespace) -> int:
    """Ratios at equal time on the texture sets."""
    chosen = [n for n in arguments.materials or TEXTURES if is_available(n)]
    if not chosen:
        return finish({}, LEAST, None)
    figures: dict[str, Any] = {name: measure_ratios(name, arguments) for name in chosen}
    values = [f["sides"]["all"]["equal_time"][0] for f in figures.values()]
    mean = float(np.exp(np.mean(np.log(values))))
    figures["geometric_mean"] = round(mean, 3)
    return finish(figures, LEAST, mean >= LEAST["geometric_mean"])


def target(arguments: argparse.Namespace) -> int:
    """Runs with a target error against the true noise."""
    rows = []
    with tempfile.TemporaryDirectory() as work:
        polished = Path(work) / "material.yaml"
        height = json.dumps(str(ASSETS / "cliff_rock" / "height.exr"))
        polished.write_text(POLISHED.format(height=height), encoding="utf-8")
        cases = [(Path(m), Path(m).name, arguments.height_scale, 1.0) for m in arguments.materials] or [
            (ASSETS / "cliff_rock", "cliff_rock", None, 1.0),
            (ASSETS / "turtle_shell", "turtle_shell", None, 1.0),
            (polished, "polished", 0.2, 5.0),
        ]
        for material, name, scale, factor in cases:
            error = factor * arguments.target
            row = measure_target(material, name, scale, error, arguments.max_spp, arguments.queries or 1500)
            rows.append(row)
            texts = (f"{k} {v:.3g}" if k != "material" else f"{v:14s}" for k, v in row.items())
            print("  ".join(texts), flush=True)
    worst = max(abs(row["z"]) for row in rows)
    return finish({"rows": rows, "largest |z|": worst}, MOST, worst < MOST["largest |z|"])


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("part", nargs="?", choices=("equal-time", "target"), default="equal-time")
    parser.add_argument("materials", nargs="*", help="names of texture sets or assets; target: paths")
    parser.add_argument("--queries", type=int, help="queries per run")
    parser.add_argument("--spp", type=int, default=16, help="mean number of paths per query (even)")
    parser.add_argument("--repeats", type=int, default=4, help="timed runs of each way")
    parser.add_argument("--target", type=float, default=0.05)
    parser.add_argument("--max-spp", type=int, default=1 << 14)
    parser.add_argument("--height-scale", type=float, help="factor on the stored heights")
    arguments = parser.parse_args()
    load_mitsuba()
    if arguments.part == "target":
        return target(arguments)
    arguments.queries = arguments.queries or 1 << 16
    return equal_time(arguments)


if __name__ == "__main__":
    start(main)
