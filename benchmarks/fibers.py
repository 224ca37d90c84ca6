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

import sys
import tempfile
from pathlib import Path

import numpy as np
from common import ASSETS, finish, parser_of, start, watched
from generator import generator_run, mitsuba_run, take_turns

from mbtf_gen.engine.runtime import load_mitsuba
from mbtf_gen.tile.loading import load_material

LEAST_RATIO = 0.5
MOST = {"gib": 2.0, "start_seconds": 30.0}
MILLION = 1_000_000
PER_FIBER = 100
# Interactions before the roulette of unmodified Mitsuba.
ROULETTE = 64


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
        command += ["--test-queries", "64", "--effects", "all", "--quiet", "-o", str(out)]
        return watched(command, out)[:2]


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--material", type=Path, default=ASSETS / "basket_weave")
    parser.add_argument("--runs", type=int, default=5, help="timed runs of each")
    parser.add_argument("--queries", type=int, default=1 << 14, help="queries per run")
    parser.add_argument("--spp", type=int, default=16, help="paths per query (even)")
    arguments = parser.parse_args()
    load_mitsuba()
    from mbtf_gen.render.path_tracer import Transport
    from mbtf_gen.render.scene import build_scene

    tile, count, spp = load_material(arguments.material), arguments.queries, arguments.spp
    scene, transport = build_scene(tile, tile.surface()), Transport(bsdf_sampling=False)
    ways = {
        "generator": generator_run(scene, tile.lattice(), transport, count, spp),
        "mitsuba": mitsuba_run(tile, count, spp, -1, ROULETTE),
    }
    rates = {name: rate["median"] for name, rate in take_turns(ways, count * spp, arguments.runs).items()}
    ratio = rates["generator"] / rates["mitsuba"]
    memory, first = million()
    print(f"generator over mitsuba {ratio:.2f}; a million control points: {memory:.2f} GiB, {first:.1f} s")
    million_points = {"gib": memory, "start_seconds": first}
    met = ratio >= LEAST_RATIO and all(million_points[name] <= most for name, most in MOST.items())
    figures = {"million_paths_per_second": rates, "ratio": ratio, **million_points}
    return finish(figures, {"ratio": LEAST_RATIO, **MOST}, met)


if __name__ == "__main__":
    start(main)
