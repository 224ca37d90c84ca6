"""How near runs to a target error come, against the true noise of every query.

    python benchmarks/target_error.py [MATERIAL ...] [--target 0.05] [--queries N] [--max-spp N]
                                      [--height-scale H]

By default ``cliff_rock`` and ``turtle_shell`` of ``assets/``, and the relief of ``cliff_rock`` in polished
metal (roughness 0.2), where few bright paths make most of the value, to five times the target. For every
query the true value and the true variance of one path are taken from 6144 paths of their own. Printed, for
each material:

- root mean square of the true standard errors relative to max(true value, tile mean), over the target, and
  of the actual errors, which low-discrepancy points make smaller; what the run itself reports (``reached``);
- coverage: share of queries whose true standard error is at most the target, and 1.25 times the target;
- paths per query, the pilots' included, and how many would do if the variances were known;
- z: mean difference from the true values over its standard error (bias).

The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import MbtfError
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.job import Job
from mbtf_gen.planning.adaptive import estimate_shard, round_up
from mbtf_gen.planning.run_plan import plan_run
from mbtf_gen.planning.simulation import build_estimator
from mbtf_gen.render.estimates import Stream, Target

ROOT = Path(__file__).resolve().parents[1]
POLISHED = "height: {height}\nroughness: 0.2\nmetallic: 1.0\n"
# Against chance: one run in ten thousand.
Z_BAR = 4.0
TRUTHS, TRUTH_PATHS = 6, 1024

F64 = NDArray[np.float64]


def measure(
    material: Path, name: str, height: float | None, error: float, cap: int, n: int
) -> dict[str, Any]:
    """One row."""
    queries = {
        "resolution": 128,
        "train": str(n),
        "test": "2",
        "test_spp": 2,
        "target_error": error,
        "max_spp": cap,
    }
    config = GeneratorConfig.model_validate(
        {"material": str(material), "geometry": {"height_scale": height}, "queries": queries}
    )
    job = Job.prepare(config)
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
        "coverage": float(np.mean(true_error <= error * 1.0001)),
        "coverage_1.25": float(np.mean(true_error <= error * 1.25)),
        "missed": found.target.missed / n,
        "paths": found.paths / n,
        "paths_if_known": float(known.mean()),
        "z": float(difference.mean() / (difference.std(ddof=1) / math.sqrt(n))),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("materials", nargs="*", type=Path)
    parser.add_argument("--target", type=float, default=0.05)
    parser.add_argument("--queries", type=int, default=1500)
    parser.add_argument("--max-spp", type=int, default=1 << 14)
    parser.add_argument("--height-scale", type=float, help="factor on the stored heights")
    options = parser.parse_args()
    rows = []
    try:
        with tempfile.TemporaryDirectory() as work:
            assets = ROOT / "assets"
            polished = Path(work) / "material.yaml"
            height = json.dumps(str(assets / "cliff_rock" / "height.exr"))
            polished.write_text(POLISHED.format(height=height), encoding="utf-8")
            cases = [(m, m.name, options.height_scale, 1.0) for m in options.materials] or [
                (assets / "cliff_rock", "cliff_rock", None, 1.0),
                (assets / "turtle_shell", "turtle_shell", None, 1.0),
                (polished, "polished", 0.2, 5.0),
            ]
            for material, name, height_scale, factor in cases:
                row = measure(
                    material, name, height_scale, factor * options.target, options.max_spp, options.queries
                )
                rows.append(row)
                print(
                    "  ".join(f"{k} {v:.3g}" if k != "material" else f"{v:14s}" for k, v in row.items()),
                    flush=True,
                )
    except MbtfError as problem:
        print(f"error: {problem}", file=sys.stderr)
        return problem.exit_code
    worst = max(abs(row["z"]) for row in rows)
    print(
        json.dumps(
            {"figures": rows, "bars": {"largest |z|": Z_BAR}, "largest |z|": worst, "met": worst < Z_BAR}
        )
    )
    return int(worst >= Z_BAR)


if __name__ == "__main__":
    sys.exit(main())
