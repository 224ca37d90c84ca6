"""Speed of the Mitsuba plugin: one 1080p picture's queries, beside PyTorch or another model.

    python benchmarks/plugin.py [--material FOLDER] [--runs 7] [--resolution 512] [--threads N]
    python benchmarks/plugin.py --model relief [--places 2] [--shadow-rays]
    python benchmarks/plugin.py --material FOLDER --shards SHARDS

The queries are those of a perspective picture of the plane: 1920 × 1080 positions, footprints and views, one
light. **unrolled** and **cooperative** are the plugin's ways to evaluate networks, **pytorch** is
``Material.evaluate``. They alternate; the first run of each compiles, from an empty kernel cache. The
material is a ``neumip`` of the paper's size with random weights, or one given.

With ``--model relief`` the material has random heights besides, and ``neumip`` takes the place of PyTorch.
**trace** (view rays alone) and **surface** (everything known of it) are parts of its time.

With ``--shards``, formats of the material's textures are compared: error on test queries of these data,
bytes, and the first picture (files are read, kernels are compiled already).

The last line is one JSON object. Thresholds hold with two threads.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, get_args

# Before drjit is imported: kernels are compiled anew.
_CACHE = tempfile.TemporaryDirectory(prefix="mbtf-kernels-")
os.environ["DRJIT_CACHE_DIR"] = _CACHE.name

import numpy as np  # noqa: E402
from common import alternate, conformance_deviation, finish, parser_of, start, timed  # noqa: E402

from mbtf_core.data.geometry import Geometry  # noqa: E402
from mbtf_core.data.lattice import Lattice  # noqa: E402
from mbtf_core.directions import from_angles  # noqa: E402
from mbtf_core.pictures import Camera  # noqa: E402
from mbtf_fit.config import ModelName  # noqa: E402
from mbtf_fit.ops.constants import PLACES  # noqa: E402
from mbtf_gen.engine.runtime import load_mitsuba  # noqa: E402

# Least ratio of PyTorch's time to the plugin's, most seconds of a first run, most deviation from conformance.
FASTER, COMPILE, DEVIATION = 3.0, 10.0, 1e-4
# Most time of `relief`, with one place, over that of `neumip`.
SLOWER = 1.5
# Displacement range of the random heights in tile widths.
RELIEF = 0.12
THREADS = 2


def ignoring_round(way: Callable[[], Any], number: int) -> None:
    """Evaluate the same queries in every round."""
    way()


def random_surface(lattice: Lattice) -> Geometry:
    """Glossy surface of random heights whose spectrum falls with the frequency squared."""
    rows, columns = lattice.shape()
    random = np.random.default_rng(0)
    waves = np.hypot(*np.meshgrid(np.fft.fftfreq(rows, 1 / rows), np.fft.fftfreq(columns, 1 / columns)))
    spectrum = np.fft.fft2(random.standard_normal((rows, columns))) / np.maximum(waves.T, 1.0) ** 2
    z = np.fft.ifft2(spectrum).real
    z = ((z - z.max()) * RELIEF / np.ptp(z)).astype(np.float32)
    down, right = np.gradient(z)
    slopes = np.stack([columns * right, -columns * down], -1).repeat(2, 0).repeat(2, 1)
    x, y = slopes[..., 0], slopes[..., 1]
    moments = np.stack([x * x, x * y, y * y], -1)
    half = np.full(x.shape, 0.5, np.float32)
    return Geometry(
        z, lattice.aspect, slopes, moments,
        base_color=np.stack([half] * 3, -1), roughness=half, metallic=half, specular=half,
    )  # fmt: skip


def random_material(folder: Path, levels: int, model: ModelName, network: dict[str, Any]) -> None:
    """Export an untrained model of the paper's size."""
    import torch

    from mbtf_fit.config import FitConfig, build_model
    from mbtf_fit.material.material import export
    from mbtf_fit.surface.known import KnownSurface

    lattice = Lattice(levels)
    built = build_model(model, lattice, **network)
    if built.tracing is not None:
        built.know(KnownSurface.of(random_surface(lattice), lattice, 1.0))
    built.initialize(torch.Generator().manual_seed(0), 0.2)
    training = {"steps": 0, "batch": 1, "seconds": 0.0, "device": "cpu", "threads": 1, "errors": {}}
    config = FitConfig.model_validate({"model": model, "network": network})
    export(built, config, folder, data={}, training=training)


def compare_formats(material: Any, shards: Path, plugin: Any, runs: int) -> dict[str, dict[str, float]]:
    """Error, bytes, and CPU time in milliseconds of a material by format of its textures."""
    from mbtf_core.data.dataset import Dataset
    from mbtf_core.stats import unexplained_variance
    from mbtf_fit.backends.mitsuba import read_material
    from mbtf_fit.data.loader import load_split
    from mbtf_fit.material.material import export
    from mbtf_fit.material.rounding import round_material
    from mbtf_fit.material.texture_formats import TextureFormat

    def fastest(way: Callable[[], Any]) -> float:
        """A busy machine takes longer, but hardly more of its processors."""
        times = []
        for _ in range(runs):
            start = time.process_time()
            way()
            times.append(time.process_time() - start)
        return 1e3 * min(times)

    def first_picture(folder: Path) -> None:
        plugin(read_material(folder), "unrolled")()

    rows = dict[str, dict[str, float]]()
    queries = load_split(Dataset.open(shards), "test")
    for form in get_args(TextureFormat):
        folder = Path(_CACHE.name) / form
        folder.mkdir()
        made, _ = round_material(material, form)
        export(made.model, made.config, folder, data={}, training=made.description["training"], form=form)
        row = {"error": unexplained_variance(made.predict(queries), *queries.halves).value}
        row["bytes"] = (folder / "weights.safetensors").stat().st_size
        row["picture"] = fastest(plugin(read_material(folder), "unrolled"))
        row["first"] = fastest(partial(first_picture, folder))
        print(form, *(f"{name} {value:.5g}" for name, value in row.items()), flush=True)
        rows[form] = row
    return rows


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--model", choices=("neumip", "relief"), default="neumip")
    parser.add_argument("--places", type=int, choices=PLACES, default=1)
    parser.add_argument("--shadow-rays", action="store_true")
    parser.add_argument("--material", type=Path)
    parser.add_argument("--shards", type=Path)
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("--resolution", type=int, default=512, help="texels across, a power of two")
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    options = parser.parse_args()
    if options.model == "neumip":
        # PyTorch itself is the baseline, not the fitter's own compiled kernel.
        os.environ["MBTF_KERNEL"] = "off"
    mi = load_mitsuba()
    import drjit as dr
    import torch

    import mbtf_fit.backends.mitsuba
    from mbtf_fit import Material
    from mbtf_fit.backends.mitsuba import Evaluator, StoredMaterial, read_material

    mbtf_fit.backends.mitsuba.register()
    torch.set_num_threads(options.threads)
    dr.set_thread_count(options.threads)
    levels = options.resolution.bit_length() - 1
    relief = {"places": options.places, "shadow_rays": options.shadow_rays}
    network = {"relief": relief} if options.model == "relief" else {}
    with tempfile.TemporaryDirectory(prefix="mbtf-material-") as made:
        folder = options.material or Path(made) / "material"
        if options.material is None:
            folder.mkdir()
            random_material(folder, levels, options.model, network)
        material, stored = Material.load(folder), read_material(folder)
        other = Path(made) / "neumip"
        other.mkdir()
        random_material(other, levels, "neumip", {})
        neumip = read_material(other)
    queries = (
        Camera(elevation=45, tiles_across=4.0, rows=1080, columns=1920).queries(from_angles(40, 30)).flat()
    )
    arrays = (queries.u, queries.sigma, queries.omega_i, queries.omega_o)
    u = mi.Point2f(queries.u.T)
    sigma = mi.Float(queries.sigma)
    light, view = mi.Vector3f(queries.omega_i.T), mi.Vector3f(queries.omega_o.T)
    dr.eval(u, sigma, light, view)

    def evaluated(function: Callable[[], Any]) -> Callable[[], None]:
        def run() -> None:
            dr.eval(function())
            dr.sync_thread()

        return run

    def plugin(material: StoredMaterial, arithmetic: Any) -> Callable[[], None]:
        evaluator = Evaluator(material, arithmetic)
        return evaluated(lambda: evaluator.value(evaluator.stage1(u, evaluator.level(sigma), view), light))

    if options.shards is not None:
        return finish(compare_formats(material, options.shards, plugin, options.runs), {}, None)
    ways: dict[str, Callable[[], Any]] = {
        "unrolled": plugin(stored, "unrolled"),
        "cooperative": plugin(stored, "cooperative"),
    }
    evaluator = Evaluator(stored)
    tracing = material.model.tracing
    baseline = "pytorch" if tracing is None else "neumip"
    if tracing is None:
        ways["pytorch"] = lambda: material.evaluate(*arrays)
    else:
        (trace, shade), level = tracing, evaluator.level(sigma)
        dr.eval(level)
        ways["neumip"] = plugin(neumip, "unrolled")
        ways["trace"] = evaluated(lambda: evaluator.stage1(u, level, view)[trace.output])
        ways["surface"] = evaluated(
            lambda: evaluator.stage2(evaluator.stage1(u, level, view), light)[shade.output]
        )
    first: dict[str, float] = {}
    for name, way in ways.items():
        first[name] = timed(way)
    seconds = alternate({name: partial(ignoring_round, way) for name, way in ways.items()}, options.runs)
    median = {name: statistics.median(s) for name, s in seconds.items()}
    for name, values in seconds.items():
        print(
            f"{name:12} median {1e3 * median[name]:6.1f} ms "
            f"({1e3 * min(values):.0f} to {1e3 * max(values):.0f}), "
            f"{queries.sigma.size / median[name] / 1e6:5.1f} M queries/s, first run {first[name]:.2f} s"
        )
    deviation = conformance_deviation(Evaluator(stored, "unrolled"), stored)
    ratio = median[baseline] / median["unrolled"]
    least = FASTER if tracing is None else 1 / SLOWER
    print(f"{ratio:.2f} times as fast as {baseline}; deviation on conformance queries {deviation:.1e}")
    fast = ratio >= least or options.places != 1 or options.shadow_rays
    met = fast and first["unrolled"] <= COMPILE and deviation <= DEVIATION
    figures = {
        "model": options.model,
        "milliseconds": {name: round(1e3 * value, 1) for name, value in median.items()},
        "first_run_seconds": {name: round(value, 2) for name, value in first.items()},
        f"times_{baseline}": round(ratio, 2),
        "conformance_deviation": deviation,
        "threads": options.threads,
    }
    thresholds = {
        f"times_{baseline}": round(least, 2),
        "first_run_seconds": COMPILE,
        "conformance_deviation": DEVIATION,
    }
    return finish(figures, thresholds, met if options.threads == THREADS else None)


if __name__ == "__main__":
    start(main)
