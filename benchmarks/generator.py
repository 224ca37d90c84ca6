"""Speed of the generator, and where its time goes.

    python benchmarks/generator.py [speed] [--material PATH] [--runs 5] [--queries 262144] [--spp 16]
    python benchmarks/generator.py steps [--runs 3]
    python benchmarks/generator.py lights [--material PATH] [--runs 3] [--queries 65536] [--spp 8]

``speed`` measures paths per second in three ways that alternate:

- **generator**: random queries (σ over all levels, both directions uniform on the projected disk) on a tile
  of 512² cells with maps of color and roughness, light of 1° RMS, at most six interactions.
- **mesh**: the same with ``geometry.tracer: mesh``, Mitsuba's ray tracing of the tile's triangles.
- **mitsuba**: ``mi.render`` with the ``path`` integrator, one directional light, the same mesh as a single
  tile from straight above, as many paths, the same depth and roulette. Its rays are coherent and all hit: it
  is the renderer's best case, not a goal for random queries.

All reflect by ``mbtf_surface``.

``steps`` traces the same queries with one step of light transport after the other: the plane alone, the first
ray, the ray to the light, light that BSDF sampling finds, and up to six interactions.

``lights`` compares training queries that share their paths, by processor time: 1, 2, 4 and 8 lights per path,
equally many paths per query, no limit on interactions.

The last line is one JSON object. The threshold holds on two cores; elsewhere the ratio is only reported.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from common import alternate, finish, parser_of, start
from numpy.typing import NDArray
from support.mitsuba_shapes import mitsuba_shapes

from mbtf_core.data.lattice import Lattice
from mbtf_gen.config.generator import Tracer
from mbtf_gen.engine.runtime import load_mitsuba
from mbtf_gen.sampling.query_sampler import LevelMixture, QueryPlan
from mbtf_gen.tile.heightfield_tile import HeightFieldTile, Tile
from mbtf_gen.tile.loading import load_material

if TYPE_CHECKING:
    from mbtf_gen.render.path_tracer import Transport
    from mbtf_gen.render.scene import TileScene

MESH = 512
DEPTH = 6
ROULETTE = 3
LIGHT_WIDTH = 1.0
THRESHOLDS = {"generator over mitsuba": 0.75}
CORES = 2


# A run of a given number.
Run = Callable[[int], None]


def noise(rng: np.random.Generator, cutoff: float) -> NDArray[np.float64]:
    """Periodic random relief (MESH, MESH) in [0, 1] of features up to `cutoff` per tile."""
    frequency = np.fft.fftfreq(MESH, 1.0 / MESH)
    radius = np.hypot(frequency[:, None], frequency[None, :])
    amplitude = np.where(radius <= cutoff, 1.0 / np.maximum(radius, 2.0) ** 1.6, 0.0)
    h = np.fft.ifft2(amplitude * np.exp(2j * np.pi * rng.random((MESH, MESH)))).real
    return (h - h.min()) / np.ptp(h)


def rocky() -> HeightFieldTile:
    """Terraces with rough flanks, 0.12 tile widths deep; color and roughness follow them."""
    rng = np.random.default_rng(1)
    coarse, fine = noise(rng, 24.0), noise(rng, 200.0)
    h = 0.7 * np.floor(6.0 * coarse) / 6.0 + 0.2 * coarse + 0.1 * fine
    h = (h - h.min()) / np.ptp(h)
    color = np.stack([0.15 + 0.5 * h, 0.12 + 0.4 * fine, 0.1 + 0.3 * coarse], axis=-1).astype(np.float32)
    return HeightFieldTile(
        height=h,
        height_scale=0.12,
        maps={"base_color": color, "roughness": 0.3 + 0.5 * fine, "metallic": 0.0, "specular": 0.5},
    )


def query_plan(lattice: Lattice, count: int) -> QueryPlan:
    """Levels log-uniform; the generator's default favors fine ones, which are faster."""
    return QueryPlan(lattice, LevelMixture(1.0, 0.0), 0.1, "shuffled", 0, count)


def generator_run(scene: TileScene, lattice: Lattice, transport: Transport, count: int, spp: int) -> Run:
    """A function that traces `count` queries, with the random numbers of a run."""
    from mbtf_gen.render.estimates import Stream
    from mbtf_gen.render.estimator import Estimator
    from mbtf_gen.sampling.light_kernel import LightKernel

    estimator = Estimator(scene, LightKernel(LIGHT_WIDTH), transport)
    queries = query_plan(lattice, count).draw("train", 0, count)

    def run(number: int) -> None:
        estimates = estimator.estimate(queries, spp, Stream(0, "train", number))
        if estimates.lost or not estimates.value_a.mean() > 0:
            raise SystemExit("rays were lost, or the picture is black: the figures mean nothing")

    return run


def mitsuba_run(material: Tile, count: int, spp: int, depth: int, roulette: int) -> Run:
    """The same for ``mi.render`` and a picture of about `count` pixels; `depth` -1 has no limit."""
    import mitsuba as mi

    from mbtf_gen.render.scene import unit_of

    unit = unit_of(material.aspect)
    columns = max(1, round((count / material.aspect) ** 0.5))
    rows = max(1, count // columns)
    # The camera looks down, its picture exactly as wide as the tile; pixels are square.
    above = mi.ScalarTransform4f().look_at(origin=[0, 0, 10 * unit], target=[0, 0, 0], up=[0, 1, 0])
    size = {"width": columns, "height": rows}
    with TemporaryDirectory() as folder:
        scene = mi.load_dict(
            {
                "type": "scene",
                # Stock depth counts the emitter's vertex too.
                "integrator": {
                    "type": "path",
                    "max_depth": depth + 1 if depth > 0 else -1,
                    "rr_depth": roulette,
                    "hide_emitters": True,
                },
                "sensor": {
                    "type": "orthographic",
                    "to_world": above @ mi.ScalarTransform4f().scale([0.5 * unit, 0.5 * unit, 1]),
                    "sampler": {"type": "independent", "sample_count": spp},
                    "film": {"type": "hdrfilm", "rfilter": {"type": "box"}, **size},
                },
                "light": {"type": "directional", "direction": [-0.5, -0.5, -0.707]},
                **mitsuba_shapes(material, unit, Path(folder), material.surface()),  # type: ignore[arg-type]
            }
        )

    def run(number: int) -> None:
        if not np.array(mi.render(scene, seed=number)).mean() > 0:
            raise SystemExit("the stock picture is black: the figures mean nothing")

    return run


def take_turns(ways: Mapping[str, Run], paths: int, rounds: int) -> dict[str, dict[str, float]]:
    """Million paths per second of each way, printed."""
    figures = {}
    for name, seconds in alternate(ways, rounds).items():
        rates = [paths / s / 1e6 for s in seconds]
        measures = {"median": statistics.median(rates), "min": min(rates), "max": max(rates)}
        figures[name] = {key: round(rate, 3) for key, rate in measures.items()}
        print(f"{name:9s} {measures['median']:.3g} M paths/s ({min(rates):.3g} to {max(rates):.3g})")
    return figures


def measure_speed(material: Tile, arguments: argparse.Namespace) -> int:
    """Paths per second in the three ways."""
    import drjit as dr

    from mbtf_gen.render.path_tracer import Transport
    from mbtf_gen.render.scene import build_scene

    material = material.at(arguments.height_scale, MESH)
    grid, count, spp = material.grid, arguments.queries, arguments.spp
    assert grid is not None

    def generator(tracer: Tracer) -> Run:
        scene = build_scene(replace(grid, tracer=tracer), material.surface())
        return generator_run(scene, Lattice.for_map(*grid.z.shape), Transport(DEPTH, ROULETTE), count, spp)

    ways = {
        "generator": generator("heightfield"),
        "mesh": generator("mesh"),
        "mitsuba": mitsuba_run(material, count, spp, DEPTH, ROULETTE),
    }
    figures = take_turns(ways, count * spp, arguments.runs)
    median = {name: rates["median"] for name, rates in figures.items()}
    ratio, cores = round(median["generator"] / median["mitsuba"], 3), dr.thread_count()
    print(f"generator over mitsuba {ratio:.2f}; {cores} threads, {count * spp} paths per run")
    report = {"million_paths_per_second": figures, "generator over mitsuba": ratio, "threads": cores}
    met = ratio >= THRESHOLDS["generator over mitsuba"]
    return finish(report, THRESHOLDS, met if cores == CORES else None)


def measure_steps(material: Tile, arguments: argparse.Namespace) -> int:
    """Time per path with one step of light transport after the other."""
    from mbtf_gen.render.path_tracer import Transport
    from mbtf_gen.render.scene import build_scene

    grid = material.at(arguments.height_scale, MESH).grid
    assert grid is not None
    scene = build_scene(grid, material.surface())
    bare: dict[str, Any] = {"shadowing": False, "interreflection": False, "bsdf_sampling": False}
    steps = {
        "plane": Transport(1, displacement=False, **bare),
        "first ray": Transport(1, **bare),
        "ray to the light": Transport(1, interreflection=False, bsdf_sampling=False),
        "light found by BSDF sampling": Transport(1, interreflection=False),
        "up to six interactions": Transport(DEPTH),
    }
    lattice, sizes = Lattice.for_map(*grid.z.shape), (arguments.queries, arguments.spp)
    ways = {name: generator_run(scene, lattice, step, *sizes) for name, step in steps.items()}
    before, rows = 0.0, []
    for name, took in alternate(ways, arguments.runs).items():
        each = 1e6 * statistics.median(took) / (arguments.queries * arguments.spp)
        rows.append({"step": name, "million_paths_per_second": 1 / each, "microseconds": each})
        print(f"{name:28s} {1 / each:6.2f} M paths/s  {each:.3f} µs per path, {each - before:+.3f}")
        before = each
    return finish(rows, {}, None)


def measure_lights(material: Tile, arguments: argparse.Namespace) -> int:
    """Processor time and noise of a query with several lights per path."""
    from mbtf_gen.render.estimates import Stream
    from mbtf_gen.render.estimator import Estimator
    from mbtf_gen.render.path_tracer import Transport
    from mbtf_gen.render.scene import build_scene
    from mbtf_gen.sampling.light_kernel import LightKernel

    estimator = Estimator(build_scene(material, material.surface()), LightKernel(LIGHT_WIDTH), Transport())
    plan, spp = query_plan(material.lattice(), arguments.queries), arguments.spp
    rows: list[dict[str, Any]] = []
    for lights in (1, 2, 4, 8):
        seconds, squares = [], []
        for number in range(arguments.runs + 1):
            queries = replace(plan, lights=lights).draw("train", number, arguments.queries)
            began = time.process_time()
            found = estimator.estimate(queries, spp, Stream(lights, "train", number), lights=lights)
            seconds.append(time.process_time() - began)
            error = (found.value_a.astype(np.float64) - found.value_b).mean(axis=1) / 2.0
            squares.append(np.mean(error**2) / np.mean(found.value_a + found.value_b) ** 2 * 4.0)
        # The first run compiles.
        each = 1e6 * statistics.median(seconds[1:]) / arguments.queries
        noise = float(np.mean(squares)) ** 0.5
        ratio = rows[0]["microseconds"] / each if rows else 1.0
        rows.append(
            {
                "lights": lights,
                "microseconds": each,
                "queries per second over one light's": ratio,
                "relative noise": noise,
            }
        )
        print(
            f"{lights} lights {each:8.2f} µs of processor time per query, {ratio:.2f} times the queries, "
            f"noise {noise:.0%} of the mean",
            flush=True,
        )
    return finish(rows, {}, None)


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("part", nargs="?", choices=("speed", "steps", "lights"), default="speed")
    parser.add_argument("--material", type=Path, help="height map, folder or material.yaml")
    parser.add_argument("--height-scale", type=float, help="factor on its stored heights")
    parser.add_argument("--runs", type=int, default=5, help="timed runs of each way")
    parser.add_argument("--queries", type=int, default=1 << 18, help="queries per run")
    parser.add_argument("--spp", type=int, default=16, help="paths per query (even)")
    arguments = parser.parse_args()
    load_mitsuba()
    material = load_material(arguments.material) if arguments.material else rocky()
    measures = {"speed": measure_speed, "steps": measure_steps, "lights": measure_lights}
    return measures[arguments.part](material, arguments)


if __name__ == "__main__":
    start(main)
