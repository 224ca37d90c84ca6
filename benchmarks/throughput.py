"""Paths per second of the estimator on random queries, beside stock Mitsuba on an easy picture.

    python benchmarks/throughput.py [--material PATH] [--runs 5] [--queries 262144] [--spp 16]

**ours**: random 7D queries (σ over all levels, both directions uniform on the projected disk) against a tile
of 512² cells with bitmaps of color and roughness, light of 1° RMS, at most 6 interactions.
**mesh**: the same with ``geometry.tracer: mesh``, Mitsuba's ray tracing of the tile's triangles.
**stock**: ``mi.render`` with the ``path`` integrator, one directional light, the same mesh as a single tile
seen straight from above by an orthographic camera, as many paths, the same limits on depth: coherent rays,
every one of which hits. It is what the renderer can do at best, not a goal for random queries.

All reflect by ``mbtf_surface`` with the same maps, and end paths by the same rule and depth. Variance
× time is the noise of a query (a pixel) of `spp` paths, relative to the mean, times the seconds of the run;
queries and pixels do not show the same, so only figures of one side are to be compared with each other.

They alternate, run by run, after one run of each that compiles the kernels. The last line is one JSON
object: figures, and the bar they are held to, which is the ratio of the first rate to the last. Exit code 1
where the bar is missed; on other than two cores it is only reported.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import MbtfError
from mbtf_core.lattice import Lattice
from mbtf_gen.config.values import Tracer
from mbtf_gen.engine.runtime import load_mitsuba
from mbtf_gen.sampling.query_sampler import Mixture, QueryPlan
from mbtf_gen.tile.heightfield_tile import HeightFieldTile
from mbtf_gen.tile.loading import load_material

if TYPE_CHECKING:
    from mbtf_gen.tile.heights.grid import HeightGrid

MESH = 512
DEPTH = 6
ROULETTE = 3
LIGHT_WIDTH = 1.0
# Our rate over the stock rate, on two cores; the aim is 1.
BAR = 0.75
BAR_CORES = 2


# (seconds, variance over the squared mean of one query or pixel) of a run of a given number.
Run = Callable[[int], tuple[float, float]]


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


def our_run(
    material: HeightFieldTile, grid: HeightGrid, count: int, spp: int, tracer: Tracer = "heightfield"
) -> Run:
    """A function of the run's number that traces `count` queries."""
    from mbtf_gen.render.estimator import Estimator, Stream
    from mbtf_gen.render.path_tracer import Transport
    from mbtf_gen.render.scene import build_scene
    from mbtf_gen.sampling.light_kernel import LightKernel

    estimator = Estimator(
        build_scene(replace(grid, tracer=tracer), material.surface()),
        LightKernel(LIGHT_WIDTH),
        Transport(DEPTH, ROULETTE),
    )
    lattice = Lattice.for_map(*grid.z.shape)
    # Levels log-uniform, as a reader of "all levels" expects; the generator's default favors fine ones,
    # which are faster.
    plan = QueryPlan(lattice, Mixture(1.0, 0.0), 0.1, "shuffled", 0, count)

    def run(number: int) -> tuple[float, float]:
        queries = plan.draw("train", number, count)
        start = time.perf_counter()
        estimates = estimator.estimate(queries, spp, Stream(0, "train", number))
        seconds = time.perf_counter() - start
        if estimates.lost or not estimates.value_a.mean() > 0:
            raise SystemExit("rays were lost, or the picture is black: the figures mean nothing")
        a, b = estimates.value_a.astype(np.float64), estimates.value_b.astype(np.float64)
        return seconds, float(np.mean((a - b) ** 2) / np.mean(a + b) ** 2)

    return run


def stock_run(material: HeightFieldTile, grid: HeightGrid, count: int, spp: int) -> Run:
    """The same for ``mi.render`` and a picture of `count` pixels."""
    import drjit as dr
    import mitsuba as mi

    from mbtf_gen.render.scene import unit_of
    from mbtf_gen.tile.heights.grid import mesh_of_grid

    unit = unit_of(grid.aspect)
    columns = max(1, round((count / grid.aspect) ** 0.5))
    rows = max(1, count // columns)
    half = 0.5 * unit
    # The camera looks down, its picture exactly as wide as the tile; pixels are square.
    above = mi.ScalarTransform4f().look_at(origin=[0, 0, 10 * unit], target=[0, 0, 0], up=[0, 1, 0])
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {
                "type": "path",
                # Stock depth counts the emitter's vertex too.
                "max_depth": DEPTH + 1,
                "rr_depth": ROULETTE,
                "hide_emitters": True,
            },
            "sensor": {
                "type": "orthographic",
                "to_world": above @ mi.ScalarTransform4f().scale([half, half, 1]),
                "sampler": {"type": "independent", "sample_count": spp},
                "film": {
                    "type": "hdrfilm",
                    "width": columns,
                    "height": rows,
                    "rfilter": {"type": "box"},
                    "component_format": "float32",
                },
            },
            "light": {"type": "directional", "direction": [-0.5, -0.5, -0.707]},
            "tile": mesh_of_grid(grid, unit, (0, 0), mi.load_dict(material.surface())),
        }
    )

    last: NDArray[np.float64] | None = None

    def run(number: int) -> tuple[float, float]:
        nonlocal last
        start = time.perf_counter()
        picture = mi.render(scene, seed=number)
        dr.eval(picture)
        dr.sync_thread()
        seconds = time.perf_counter() - start
        image = np.array(picture, np.float64)
        if not image.mean() > 0:
            raise SystemExit("the stock picture is black: the figures mean nothing")
        # From this run's picture and the one before, of other random numbers.
        variance = (
            float("nan") if last is None else float(np.mean((image - last) ** 2) / 2 / image.mean() ** 2)
        )
        last = image
        # As if it had exactly as many paths as ours.
        return seconds * count / (rows * columns), variance

    return run


def spread(seconds: list[float], paths: int) -> dict[str, float]:
    """Median, smallest and largest rate in million paths per second."""
    rates = [paths / s / 1e6 for s in seconds]
    return {
        "median": round(statistics.median(rates), 3),
        "min": round(min(rates), 3),
        "max": round(max(rates), 3),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--material", type=Path, help="height map, folder or material.yaml; own one by default"
    )
    parser.add_argument("--height-scale", type=float, help="factor on its stored heights")
    parser.add_argument("--runs", type=int, default=5, help="timed runs of each")
    parser.add_argument("--queries", type=int, default=1 << 18, help="queries per run")
    parser.add_argument("--spp", type=int, default=16, help="paths per query (even)")
    arguments = parser.parse_args()
    try:
        load_mitsuba()
        material = load_material(arguments.material) if arguments.material else rocky()
    except MbtfError as error:
        print(f"error: {error.message}", file=sys.stderr)
        return error.exit_code
    import drjit as dr

    grid = material.at(arguments.height_scale, MESH).grid
    makers: dict[str, Any] = {"ours": our_run, "mesh": partial(our_run, tracer="mesh"), "stock": stock_run}
    runs = {name: make(material, grid, arguments.queries, arguments.spp) for name, make in makers.items()}
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    variances: dict[str, list[float]] = {name: [] for name in runs}
    for number in range(-1, arguments.runs):
        for name, run in runs.items():
            took, variance = run(number + 1)
            if number >= 0:
                seconds[name].append(took)
                variances[name].append(variance)
                print(f"run {number + 1}: {name:5s} {took:.2f} s", file=sys.stderr)
    paths = arguments.queries * arguments.spp
    figures = {name: spread(took, paths) for name, took in seconds.items()}
    cores = dr.thread_count()
    products = {
        name: float(f"{statistics.median(seconds[name]) * statistics.mean(variances[name]):.3g}")
        for name in runs
    }
    for name, rates in figures.items():
        print(
            f"{name:5s} {rates['median']:.2f} M paths/s ({rates['min']:.2f} to {rates['max']:.2f}), "
            f"relative variance x time {products[name]:.3g} s"
        )
    ratio = round(figures["ours"]["median"] / figures["stock"]["median"], 3)
    over_mesh = round(figures["ours"]["median"] / figures["mesh"]["median"], 3)
    print(f"ours / stock {ratio:.2f}, ours / mesh {over_mesh:.2f}; {cores} threads, {paths} paths per run")
    met = ratio >= BAR
    report = {
        "figures": {
            "million_paths_per_second": figures,
            "ours_over_stock": ratio,
            "ours_over_mesh": over_mesh,
            "relative_variance_times_seconds": products,
            "threads": cores,
            "paths_per_run": paths,
            "material": str(arguments.material) if arguments.material else "own relief",
        },
        "bars": {"ours_over_stock_on_two_cores": BAR},
        "met": met if cores == BAR_CORES else None,
    }
    print(json.dumps(report))
    return 1 if cores == BAR_CORES and not met else 0


if __name__ == "__main__":
    sys.exit(main())
