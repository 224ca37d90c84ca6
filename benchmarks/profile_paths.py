"""Where the generator's time goes: the same queries with one effect after the other.

    python benchmarks/profile_paths.py [--queries 65536] [--spp 16] [--runs 3]

The scene is that of ``throughput.py``. Each row adds something to the one before: the plane alone (points,
light, surface, sums), the first ray, the ray towards the light, the light that sampling the surface finds,
and paths of up to six interactions. The difference of two rows' microseconds is what that step costs.

The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from typing import Any

from throughput import DEPTH, LIGHT_WIDTH, MESH, rocky

from mbtf_core.errors import MbtfError
from mbtf_core.lattice import Lattice
from mbtf_gen.engine.runtime import load_mitsuba
from mbtf_gen.sampling.query_sampler import Mixture, QueryPlan


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--queries", type=int, default=1 << 16)
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--runs", type=int, default=3)
    arguments = parser.parse_args()
    try:
        load_mitsuba()
    except MbtfError as error:
        print(f"error: {error.message}", file=sys.stderr)
        return error.exit_code
    from mbtf_gen.render.estimator import Estimator, Stream
    from mbtf_gen.render.path_tracer import Transport
    from mbtf_gen.render.scene import build_scene
    from mbtf_gen.sampling.light_kernel import LightKernel

    material = rocky()
    grid = material.at(None, MESH).grid
    tile = build_scene(grid, material.surface())
    bare: dict[str, Any] = {"shadowing": False, "interreflection": False, "bsdf_sampling": False}
    steps = {
        "plane": Transport(1, displacement=False, **bare),
        "first ray": Transport(1, **bare),
        "ray to the light": Transport(1, interreflection=False, bsdf_sampling=False),
        "light found by the surface": Transport(1, interreflection=False),
        "up to six interactions": Transport(DEPTH),
    }
    plan = QueryPlan(Lattice.for_map(*grid.z.shape), Mixture(1.0, 0.0), 0.1, "shuffled", 0, arguments.queries)
    estimators = {name: Estimator(tile, LightKernel(LIGHT_WIDTH), step) for name, step in steps.items()}
    seconds: dict[str, list[float]] = {name: [] for name in steps}
    for number in range(arguments.runs + 1):
        queries = plan.draw("train", number, arguments.queries)
        for name, estimator in estimators.items():
            start = time.perf_counter()
            estimator.estimate(queries, arguments.spp, Stream(0, "train", number))
            if number:
                seconds[name].append(time.perf_counter() - start)
    paths = arguments.queries * arguments.spp
    before, rows = 0.0, []
    for name, took in seconds.items():
        each = 1e6 * statistics.median(took) / paths
        rows.append({"step": name, "million_paths_per_second": 1 / each, "microseconds": each})
        print(f"{name:28s} {1 / each:6.2f} M paths/s  {each:.3f} µs per path, {each - before:+.3f}")
        before = each
    print(json.dumps({"figures": rows, "bars": {}, "met": None}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
