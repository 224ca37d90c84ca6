"""Speed and memory of fibers: paths per second, and a tile of a million control points.

    python benchmarks/fibers.py [--material assets/basket_weave] [--runs 5] [--queries 16384] [--spp 16]

- **generator**: random queries (σ over all levels, both directions uniform on the projected disk), all
  interactions of light until roulette ends a path.
- **mitsuba**: ``mi.render`` with the ``path`` integrator without a limit on depth, one directional light, the
  same fibers of one period from above, as many paths, roulette from the 64th interaction: before it, the
  generator ends few paths of such cloth either.

They alternate. Then a process of its own generates a small data set from a felt of a million control points:
its peak memory, and the time from its start to its first shard. The last line is one JSON object.
"""

from __future__ import annotations

import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from common import ASSETS, alternate, finish, parser_of, start

from mbtf_gen.engine.runtime import load_mitsuba
from mbtf_gen.sampling.query_sampler import LevelMixture, QueryPlan
from mbtf_gen.tile.fiber_tile import FiberTile
from mbtf_gen.tile.loading import load_material

LEAST_RATIO = 0.5
MOST = {"gib": 2.0, "start_seconds": 30.0}
MILLION = 1_000_000
PER_FIBER = 100


def generator_run(material: Path, count: int, spp: int) -> Callable[[int], None]:
    """A function of the run's number that traces `count` queries."""
    from mbtf_gen.render.estimates import Stream
    from mbtf_gen.render.estimator import Estimator
    from mbtf_gen.render.path_tracer import Transport
    from mbtf_gen.render.scene import build_scene
    from mbtf_gen.sampling.light_kernel import LightKernel

    loaded = load_material(material)
    transport = Transport(bsdf_sampling=False)
    estimator = Estimator(build_scene(loaded, loaded.surface()), LightKernel(1.0), transport)
    plan = QueryPlan(loaded.lattice(), LevelMixture(1.0, 0.0), 0.1, "shuffled", 0, count)

    def run(number: int) -> None:
        queries = plan.draw("train", number, count)
        estimates = estimator.estimate(queries, spp, Stream(0, "train", number))
        if not estimates.value_a.mean() > 0:
            raise SystemExit("the values are black: the figures mean nothing")

    return run


def mitsuba_run(material: Path, count: int, spp: int) -> Callable[[int], None]:
    """The same for ``mi.render`` and a picture of `count` pixels."""
    import drjit as dr
    import mitsuba as mi

    from mbtf_gen.render.scene import unit_of

    fibers = load_material(material)
    assert isinstance(fibers, FiberTile)
    unit = unit_of(fibers.aspect)
    runs, _ = fibers.runs()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "curves.txt"
        with file.open("w") as text:
            for points in runs:
                np.savetxt(text, (points - (0.5, 0.5 * fibers.aspect, 0.0, 0.0)) * unit, fmt="%.9g")
                text.write("\n")
        columns = round((count / fibers.aspect) ** 0.5)
        above = mi.ScalarTransform4f().look_at([0, 0, unit], [0, 0, 0], [0, 1, 0])
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "path", "max_depth": -1, "rr_depth": 64, "hide_emitters": True},
                "sensor": {
                    "type": "orthographic",
                    "to_world": above @ mi.ScalarTransform4f().scale([0.5 * unit, 0.5 * unit, 1]),
                    "sampler": {"type": "independent", "sample_count": spp},
                    "film": {
                        "type": "hdrfilm",
                        "width": columns,
                        "height": count // columns,
                        "rfilter": {"type": "box"},
                    },
                },
                "light": {"type": "directional", "direction": [-0.5, -0.5, -0.707]},
                "curves": {"type": "bsplinecurve", "filename": str(file), "bsdf": fibers.surface()},
            }
        )

    def run(number: int) -> None:
        picture = mi.render(scene, seed=number)
        dr.eval(picture)
        dr.sync_thread()
        if not np.array(picture).mean() > 0:
            raise SystemExit("the picture is black: the figures mean nothing")

    return run


def felt(path: Path) -> None:
    """A file of a million control points: straight, wavy fibers along both sides of a square."""
    rng = np.random.default_rng(0)
    s = np.arange(-1, PER_FIBER - 1) / (PER_FIBER - 3)
    with path.open("w") as text:
        for k in range(MILLION // PER_FIBER):
            across = rng.random() + 0.01 * np.sin(2.0 * np.pi * (s + rng.random()))
            points = [s, across] if k % 2 else [across, s]
            rows = np.column_stack(
                [*points, np.full(PER_FIBER, -0.1 * rng.random()), np.full(PER_FIBER, 5e-4)]
            )
            np.savetxt(text, rows, fmt="%.7g")
            text.write("\n")


def million() -> tuple[float, float]:
    """(peak memory in GiB, seconds from the start to the first shard) of a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        felt(Path(folder) / "felt.curves")
        material = Path(folder) / "felt.yaml"
        material.write_text("curves: felt.curves\nperiod: [1, 1]\n")
        out = Path(folder) / "shards"
        command = [sys.executable, "-m", "mbtf_gen", str(material), "--queries", "8192", "--spp", "2"]
        command += ["--test-queries", "64", "--effects", "all", "-o", str(out)]
        start = time.perf_counter()
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as child:
            while child.poll() is None and not list(out.glob("train-*.json")):
                time.sleep(0.1)
            seconds = time.perf_counter() - start
            if child.wait():
                raise SystemExit(f"the run ended with code {child.returncode}")
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20, seconds


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--material", type=Path, default=ASSETS / "basket_weave")
    parser.add_argument("--runs", type=int, default=5, help="timed runs of each")
    parser.add_argument("--queries", type=int, default=1 << 14, help="queries per run")
    parser.add_argument("--spp", type=int, default=16, help="paths per query (even)")
    arguments = parser.parse_args()
    load_mitsuba()
    makers = {"generator": generator_run, "mitsuba": mitsuba_run}
    runs = {n: make(arguments.material, arguments.queries, arguments.spp) for n, make in makers.items()}
    paths = arguments.queries * arguments.spp
    seconds = alternate(runs, arguments.runs)
    rates = {name: paths / statistics.median(took) / 1e6 for name, took in seconds.items()}
    for name, rate in rates.items():
        print(f"{name:9s} {rate:.3f} M paths/s")
    ratio = rates["generator"] / rates["mitsuba"]
    print(f"generator over mitsuba {ratio:.2f}, {os.cpu_count()} cores")
    memory, first = million()
    print(f"a million control points: {memory:.2f} GiB, {first:.1f} s to the first shard")
    figures = {"million_paths_per_second": rates, "ratio": ratio, "gib": memory, "start_seconds": first}
    met = ratio >= LEAST_RATIO and all(figures[name] <= most for name, most in MOST.items())
    return finish(figures, {"ratio": LEAST_RATIO, **MOST}, met)


if __name__ == "__main__":
    start(main)
