"""What `gpu.py` measures, each in a process of its own, as a compiler or driver may abort it.

Every function takes texts and yields JSON objects, as :func:`mbtf_core.run.processes.run_child` asks. Devices
are ``cpu`` and ``cuda``.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from common import conformance_deviation, timed

from mbtf_core.data.schema import Layout
from mbtf_core.errors import InputError
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.engine.runtime import CPU_VARIANT, CUDA_VARIANT

if TYPE_CHECKING:
    from mbtf_core.data.schema import Queries

VARIANTS = {"cpu": CPU_VARIANT, "cuda": CUDA_VARIANT}
# File of a fit's values at the test queries.
PREDICTIONS = "predictions.npz"
Answers = Iterator[dict[str, Any]]


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes
    ----------
    material : asset or other input of the generator
    resolution : texels across at the finest level
    train, test, spp : training queries per texel, test queries, and paths of each test query
    images : images of the image layout
    steps, batch : training of the models
    image_steps, image_batch : training of models that need the image layout
    rows, columns : pixels of the picture that is evaluated
    """

    material: str
    resolution: int = 64
    train: int = 200
    test: int = 8192
    spp: int = 1024
    images: int = 64
    steps: int = 1000
    batch: int = 1 << 15
    image_steps: int = 100
    image_batch: int = 1 << 12
    rows: int = 1080
    columns: int = 1920

    def text(self) -> str:
        """As an argument of a child process."""
        return json.dumps(asdict(self))

    @classmethod
    def read(cls, text: str) -> Sizes:
        """Inverse of :meth:`text`."""
        return cls(**json.loads(text))


def configuration(sizes: Sizes, layout: Layout) -> GeneratorConfig:
    """Options of the data sets."""
    texels = sizes.resolution**2
    train = sizes.train * texels if layout == "shuffled" else sizes.images * texels
    queries = {
        "resolution": sizes.resolution,
        "train": str(train),
        "test": str(sizes.test),
        "layout": layout,
    }
    return GeneratorConfig.model_validate(
        {"material": sizes.material, "geometry": {"mesh": sizes.resolution}, "queries": queries}
    )


def save_finite(path: str | Path, **arrays: Any) -> None:
    """Write arrays to a file; an InputError if some number is not finite."""
    for name, array in arrays.items():
        bad = int(np.count_nonzero(~np.isfinite(array)))
        if bad:
            raise InputError(f"{bad} of {array.size} numbers of {name} are not finite")
    np.savez(path, **arrays)


def selftest() -> Answers:
    """State of every check of ``mbtf-gen selftest``, or why it could not run."""
    from mbtf_gen.diagnostics.checks import run_check
    from mbtf_gen.diagnostics.selftest import all_checks
    from mbtf_gen.engine.runtime import load_mitsuba

    load_mitsuba()
    for found in map(run_check, all_checks()):
        yield {found.name: found.found if found.state == "failed" else found.state}


def generate_data(sizes: str, layout: Layout, folder: str) -> Answers:
    """A data set, on the CPU."""
    from mbtf_gen.generation.run import generate

    summary = generate(configuration(Sizes.read(sizes), layout), folder)
    yield {"paths": summary.paths}


def estimate(device: str, sizes: str, shards: str, out: str) -> Answers:
    """Both halves at the test queries of a data set, with its random numbers and effects, as arrays in a
    file; rate of a second run, as the first one compiles."""
    from mbtf_core.data.dataset import Dataset
    from mbtf_core.data.schema import Queries
    from mbtf_fit.data.loader import load_split
    from mbtf_gen.generation.folder import read_run_plan
    from mbtf_gen.planning.job import Job
    from mbtf_gen.planning.simulation import build_estimator
    from mbtf_gen.render.estimates import Stream

    wanted = Sizes.read(sizes)
    data = Dataset.open(shards)
    job = Job.load(configuration(wanted, data.layout))
    estimator = build_estimator(job, read_run_plan(Path(shards)).effects, variant=VARIANTS[device])
    test = load_split(data, "test")
    queries = Queries(test.u, test.sigma, test.omega_i, test.omega_o)
    seconds = []
    for number in (1, 0):
        start = time.perf_counter()
        found = estimator.estimate(queries, wanted.spp, Stream(job.config.seed, "test", number))
        seconds.append(time.perf_counter() - start)
    # The values of the second run, whose random numbers are those of the first shard.
    save_finite(out, sigma=test.sigma, value_a=found.value_a, value_b=found.value_b)
    yield {
        "first_seconds": seconds[0],
        "queries_per_second": len(test) / seconds[1],
        "paths_per_second": len(test) * wanted.spp / seconds[1],
        "lost": found.lost,
    }


def train(device: str, model: str, sizes: str, shards: str, out: str) -> Answers:
    """Test error and rate of a fit of so many steps; its values at the test queries, and both halves of the
    data, as arrays in its folder."""
    from mbtf_core.data.dataset import Dataset
    from mbtf_fit import FitConfig, fit
    from mbtf_fit.data.loader import load_split
    from mbtf_fit.models.registry import MODELS

    wanted = Sizes.read(sizes)
    steps, batch = wanted.steps, wanted.batch
    if MODELS[model].layout == "image":
        steps, batch = wanted.image_steps, wanted.image_batch
    config = FitConfig.model_validate(
        {"model": model, "device": device, "training": {"steps": steps, "batch": batch}}
    )
    result = fit(config, shards, out, overwrite=True)
    queries = load_split(Dataset.open(shards), "test")
    prediction = result.material.predict(queries)
    np.savez(Path(out, PREDICTIONS), prediction=prediction, value_a=queries.value_a, value_b=queries.value_b)
    training, test = result.material.description["training"], result.errors["test"]["unexplained"]
    yield {
        "device": training["device"],
        "backend": training["backend"],
        "queries_per_second": training["steps"] * training["batch"] / max(result.seconds, 1e-3),
        "unexplained": test["value"],
        "error": test["error"],
    }


def picture(sizes: Sizes) -> Queries:
    """Queries of a perspective picture of the plane."""
    from mbtf_core.directions import from_angles
    from mbtf_core.pictures import Camera

    camera = Camera(elevation=45, tiles_across=4.0, rows=sizes.rows, columns=sizes.columns)
    return camera.queries(from_angles(40, 30)).flat()


def seconds_of(work: Callable[[], object]) -> dict[str, float]:
    """Seconds of a first run, which compiles, and the least milliseconds of three more."""
    seconds = [timed(work) for _ in range(4)]
    return {"first_seconds": seconds[0], "milliseconds": 1e3 * min(seconds[1:])}


def infer(device: str, sizes: str, folder: str) -> Answers:
    """Deviation of a material's conformance values in PyTorch, and time of a picture."""
    from mbtf_fit import Material

    material = Material.load(folder, device)
    names = ("u", "sigma", "omega_i", "omega_o")
    yield {"deviation": conformance_deviation(material, material)}
    # Fewer for a model that reads many positions.
    every = slice(None, None, material.model.positions)
    queries = picture(Sizes.read(sizes))
    arrays = [getattr(queries, name)[every] for name in names]
    yield {"queries": len(arrays[0])} | seconds_of(lambda: material.evaluate(*arrays))


def evaluate_plugin(device: str, arithmetic: Any, sizes: str, folder: str) -> Answers:
    """The same by the Mitsuba plugin, with one arithmetic of its networks."""
    from mbtf_fit.backends.mitsuba import register

    # Before what imports Dr.Jit.
    register(VARIANTS[device])
    import drjit as dr
    import mitsuba as mi

    from mbtf_fit.backends.mitsuba import Evaluator, read_material

    stored = read_material(folder)
    evaluator = Evaluator(stored, arithmetic)
    yield {"deviation": conformance_deviation(evaluator, stored)}
    queries = picture(Sizes.read(sizes))
    u, sigma = mi.Point2f(queries.u.T), mi.Float(queries.sigma)
    light, view = mi.Vector3f(queries.omega_i.T), mi.Vector3f(queries.omega_o.T)
    dr.eval(u, sigma, light, view)

    def work() -> None:
        dr.eval(evaluator.value(evaluator.stage1(u, evaluator.level(sigma), view), light))
        dr.sync_thread()

    yield {"queries": len(queries.sigma)} | seconds_of(work)


def evaluate_slang(device: str, networks: str, sizes: str, folder: str) -> Answers:
    """The deviation of the Slang module, by CUDA; of its cooperative vectors by Vulkan."""
    from support.slang_device import SlangDevice

    from mbtf_fit import Material
    from mbtf_fit.backends.shader.slang import module_of

    material, cooperative = Material.load(folder), networks == "cooperative"
    kind = "cpu" if device == "cpu" else "vulkan" if cooperative else "cuda"
    with tempfile.TemporaryDirectory() as module:
        slang = SlangDevice(*module_of(material), Path(module), cooperative=cooperative, kind=kind)
        yield {"deviation": conformance_deviation(slang, material)}


def render(device: str, sizes: str, folder: str, out: str) -> Answers:
    """Two pictures of a ball of the material, of other random numbers, as arrays in a file."""
    from mbtf_fit.backends.mitsuba import register

    register(VARIANTS[device])
    import mitsuba as mi

    from mbtf_fit.backends.mitsuba import load_scene

    wanted = Sizes.read(sizes)
    scene = load_scene(
        {
            "type": "scene",
            "integrator": {"type": "mbtf_path", "max_depth": 3},
            "ball": {"type": "sphere", "bsdf": {"type": "mbtf", "material": folder, "uv_scale": 4.0}},
            "light": {"type": "constant"},
            "sensor": {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f().look_at([0, -5, 2], [0, 0, 0], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": wanted.columns // 8, "height": wanted.rows // 8},
            },
        }
    )
    start = time.perf_counter()
    pictures = [np.array(mi.render(scene, spp=16, seed=seed), np.float32)[..., :3] for seed in (1, 2)]
    seconds = time.perf_counter() - start
    first, second = (picture.reshape(-1, 3) for picture in pictures)
    save_finite(out, value_a=first, value_b=second)
    yield {"seconds": seconds}
