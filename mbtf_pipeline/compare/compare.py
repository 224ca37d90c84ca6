"""The compare stage: renders references, evaluates fits at the same pixels, and measures their errors."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.color import ALBEDO_EXPOSURE, auto_exposure, brightness, white_of
from mbtf_core.directions import from_angles
from mbtf_core.errors import PartialError
from mbtf_core.files.atomic import write_json
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_pipeline.compare.image_files import PICTURES, Scene, scenes, with_ending, write_channels, write_map
from mbtf_pipeline.compare.metrics import DEFINITIONS, dataset_errors, image_errors
from mbtf_pipeline.compare.offsets import write_offsets
from mbtf_pipeline.compare.perceptual_metrics import perceptual_scores, require
from mbtf_pipeline.compare.timing import measure_timing, timed
from mbtf_pipeline.recipe import CompareSection

if TYPE_CHECKING:
    from mbtf_core.pictures import PixelKind, ReferenceImage
    from mbtf_core.run.runner import Runner
    from mbtf_fit import Material
    from mbtf_gen.planning.job import Job

COMPARISON_NAME = "comparison.json"
COMPARISON_FORMAT = "mbtf-comparison"
# Raised when the record or its files change; part of the stage's key.
COMPARISON_SCHEMA = 14

F32 = NDArray[np.float32]
Progress = Callable[[str], None]
# Timings refer to one query per pixel of 1080p.
_TIMED_PIXELS = 1920 * 1080


def steps(compare: CompareSection, fits: int) -> int:
    """How often :func:`compare` reports progress."""
    return len(list(scenes(compare))) * (len(compare.kinds) + fits)


def compare(
    section: CompareSection,
    generate: GeneratorConfig,
    shards: Path,
    fits: Mapping[str, Path],
    out: Path,
    progress: Progress,
    runner: Runner,
) -> None:
    """Render references with the runner, evaluate all fits (folders by name) at the same pixels, and measure
    their errors, also on the test split of a data set.

    Writes images and records into the folder `out`, ``comparison.json`` last; `progress` is called with a
    short note after each image. An InputError where the material, the data set or a fit cannot be read, an
    EngineError where the weights of ST-LPIPS are not installed.
    """
    from mbtf_core.data.dataset import Dataset
    from mbtf_fit import Material
    from mbtf_gen.pictures.reference import picture_estimator
    from mbtf_gen.planning.job import Job

    if section.st_lpips:
        require()
    (out / PICTURES).mkdir(parents=True, exist_ok=True)
    materials = {name: Material.load(folder) for name, folder in fits.items()}
    start = time.perf_counter()
    job = Job.load(generate)
    section = section.at(job.lattice.shape()[1])
    estimator = picture_estimator(job)
    rendered = _render_references(section, job, progress, runner)
    seconds = time.perf_counter() - start
    # White of the metrics: from the query references if there are any, otherwise from the pixel references.
    exposure = auto_exposure(brightness(next(iter(images.values())).value) for _, images in rendered)
    white = white_of(exposure)
    pictures = [
        _compare_scene(scene, images, materials, white, section.st_lpips, out, progress)
        for scene, images in rendered
    ]
    data = Dataset.open(shards)
    record: dict[str, Any] = {
        "format": COMPARISON_FORMAT,
        "schema": COMPARISON_SCHEMA,
        "fits": list(fits),
        "kinds": list(section.kinds),
        "size": section.size,
        "spp": section.spp,
        "exposure": exposure,
        "white": white,
        "finest": data.lattice.finest,
        "test_spp": data.manifest["splits"]["test"]["spp"],
        "definitions": DEFINITIONS,
        "pictures": pictures,
        "test": dataset_errors(materials, data),
        "offsets": write_offsets(estimator, materials, section.offset_views, data.lattice, out),
        "seconds": {"references": round(seconds, 3)},
    }
    if section.timing:
        import torch

        devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
        record["timing"] = {
            name: [measure_timing(Material.load(folder, d), _TIMED_PIXELS, d) for d in devices]
            for name, folder in fits.items()
        }
    write_json(out / COMPARISON_NAME, record)


def _render_references(
    section: CompareSection, job: Job, progress: Progress, runner: Runner
) -> list[tuple[Scene, dict[PixelKind, ReferenceImage]]]:
    """References by scene and kind."""
    from mbtf_core.run.task import Item
    from mbtf_gen.pictures.reference import render_reference

    common = {"source": job, "spp": section.spp, "seed": section.seed}
    items = []
    for scene, kind in product(scenes(section), section.kinds):
        omega_i = from_angles(scene.light.elevation, scene.light.azimuth)
        own = {"camera": scene.camera(section.size), "omega_i": omega_i, "kind": kind, "index": scene.index}
        items.append(Item(f"{scene.name}-{kind}", {**common, **own}))
    rendered: dict[str, ReferenceImage] = {}
    for done in runner.map(render_reference, items):
        if done.error:
            hint = "the same command resumes the run"
            raise PartialError(f"picture {done.name} failed: {done.error}", hint=hint)
        rendered[done.name] = done.value
        progress(f"reference {done.name}")
    return [
        (scene, {kind: rendered[f"{scene.name}-{kind}"] for kind in section.kinds})
        for scene in scenes(section)
    ]


def _compare_scene(
    scene: Scene,
    images: Mapping[PixelKind, ReferenceImage],
    materials: Mapping[str, Material],
    white: float,
    with_st_lpips: bool,
    out: Path,
    progress: Progress,
) -> dict[str, Any]:
    """Write the images of one scene and measure their errors."""
    from mbtf_core.data.lattice import level_of_sigma
    from mbtf_core.pictures import write_display
    from mbtf_core.stats import mean_estimate, mse_difference, pooled_relative_error

    record: dict[str, Any] = {
        "name": scene.name,
        "view": scene.view.model_dump(),
        "light": scene.light.model_dump(),
        "tiles_across": scene.tiles_across,
        "references": {},
        "fits": {},
    }
    for kind, image in images.items():
        file = scene.file(f"reference-{kind}")
        image.write(out / file)
        write_display(out / file, image.value, ALBEDO_EXPOSURE)
        noise = pooled_relative_error(image.value_a.reshape(-1, 3), image.value_b.reshape(-1, 3))
        record["references"][kind] = {"file": file, "noise": noise.as_dict()}
    if len(images) == 2:
        query, pixel = images["query"], images["pixel"]
        # Halves are independent: the product is the squared difference without the noise of either.
        a, b = (x.astype(np.float64) for x in (query.value_a, query.value_b))
        square = ((a - pixel.value_a) * (b - pixel.value_b)).reshape(-1, 3)
        record["between_references"] = mean_estimate(square).as_dict()
    main_kind, main = next(iter(images.items()))
    record["references"][main_kind] |= perceptual_scores(main.value_a, main.value_b, white, with_st_lpips)[0]
    assert main.queries is not None
    flat = main.queries.flat()
    level = level_of_sigma(flat.sigma)
    record["levels"] = [round(float(level.min()), 3), round(float(level.max()), 3)]
    arrays = flat.u, flat.sigma, flat.omega_i, flat.omega_o
    halves = [x.reshape(-1, 3) for x in (main.value_a, main.value_b)]
    first: F32 | None = None
    for name, material in materials.items():
        flat_value, seconds = timed(partial(material.evaluate, *arrays))
        value = flat_value.reshape(main.value.shape)
        file = scene.file(f"fit-{name}")
        write_channels(with_ending(out / file, ".exr"), value, "RGB")
        write_display(out / file, value, ALBEDO_EXPOSURE)
        scores, hdr_flip = perceptual_scores(value, main.value, white, with_st_lpips)
        write_map(out / file, hdr_flip)
        errors = {kind: image_errors(value, x.value_a, x.value_b, white) for kind, x in images.items()}
        record["fits"][name] = {
            "file": file,
            "seconds": round(seconds, 4),
            "errors": {kind: {key: e.as_dict() for key, e in of.items()} for kind, of in errors.items()},
            **scores,
        }
        if first is None:
            first = flat_value
        else:
            difference = mse_difference(flat_value, first, *halves)
            record["fits"][name]["mse_minus_first"] = difference.as_dict()
        progress(f"{name} {scene.name}")
    return record
