"""The compare stage: renders references, evaluates fits at the same pixels, and measures their errors."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.atomic import write_json
from mbtf_core.directions import from_angles
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_pipeline.compare.dataset_errors import dataset_errors
from mbtf_pipeline.compare.metrics import DEFINITIONS, image_errors, reference_difference, white_point
from mbtf_pipeline.compare.offsets import write_offsets
from mbtf_pipeline.compare.perceptual_metrics import perceptual_scores
from mbtf_pipeline.compare.pictures import (
    PICTURES,
    Scene,
    fit_name,
    reference_name,
    scenes,
    write_map,
    write_picture,
    write_preview,
)
from mbtf_pipeline.compare.st_lpips import require
from mbtf_pipeline.compare.timing import measure_timing, timed
from mbtf_pipeline.compare.unmodified_mitsuba import pick_scene, write_agreement
from mbtf_pipeline.recipe import CompareSection

if TYPE_CHECKING:
    from mbtf_fit import Material
    from mbtf_gen.pictures.camera import PixelKind
    from mbtf_gen.pictures.reference import ReferenceImage
    from mbtf_gen.render.estimator import Estimator

COMPARISON_NAME = "comparison.json"
COMPARISON_FORMAT = "mbtf-comparison"
# Raised when the record or its files change; part of the stage's key.
COMPARISON_SCHEMA = 6

F32 = NDArray[np.float32]
Progress = Callable[[str], None]
# Timings refer to one query per pixel of 1080p.
_TIMED_PIXELS = 1920 * 1080


def steps(compare: CompareSection, fits: int) -> int:
    """How often :func:`compare` reports progress."""
    pictures = sum(1 for _ in scenes(compare))
    return pictures * (len(compare.kinds) + fits)


def compare(
    section: CompareSection,
    generate: GeneratorConfig,
    shards: Path,
    fits: Mapping[str, Path],
    out: Path,
    progress: Progress,
) -> dict[str, Any]:
    """Render references, evaluate all fits at the same pixels, and measure their errors.

    Parameters
    ----------
    section : CompareSection
        Views, lights, widths of the field of view, and image size.
    generate : GeneratorConfig
        Material, geometry, light and transport.
    shards : Path
        Data set whose test split the fits are evaluated on.
    fits : mapping of str to Path
        Folder of the fitted material by name of the fit.
    out : Path
        Folder for images and records; ``comparison.json`` is written last.
    progress : callable
        Called with a short note after each image.

    Returns
    -------
    dict
        Content of ``comparison.json``.

    Raises
    ------
    InputError
        The material, the data set or a fit cannot be read.
    UsageError
        ``unmodified_mitsuba`` is set and no scene is suitable for it.
    EngineError
        ST-LPIPS is requested and its weights are not installed.
    """
    from mbtf_fit import Material
    from mbtf_gen.dataset.reader import Dataset
    from mbtf_gen.job import Job
    from mbtf_gen.material.material import load_material
    from mbtf_gen.planning.effects_plan import reference_plan
    from mbtf_gen.planning.simulation import build_estimator

    if section.st_lpips:
        require()
    if section.unmodified_mitsuba:
        pick_scene(section)
    (out / PICTURES).mkdir(parents=True, exist_ok=True)
    materials = {name: Material.load(folder) for name, folder in fits.items()}
    start = time.perf_counter()
    material = load_material(Path(generate.material), generate.geometry.make_tileable)
    job = Job(generate, material)
    estimator = build_estimator(job, reference_plan(job))
    rendered = _render_references(section, estimator, progress)
    seconds = {"references": time.perf_counter() - start}
    # From the query references if there are any, otherwise from the pixel references.
    white = white_point([next(iter(images.values())).value for _, images in rendered])
    start = time.perf_counter()
    pictures = [
        _compare_scene(scene, images, materials, white, section.st_lpips, out, progress)
        for scene, images in rendered
    ]
    seconds["fits"] = time.perf_counter() - start
    data = Dataset.open(shards)
    offsets = write_offsets(estimator, materials, section.offset_views, data.lattice, out)
    record: dict[str, Any] = {
        "format": COMPARISON_FORMAT,
        "schema": COMPARISON_SCHEMA,
        "fits": list(fits),
        "kinds": list(section.kinds),
        "size": section.size,
        "spp": section.spp,
        "white": white,
        "finest": data.lattice.finest,
        "test_spp": data.manifest["splits"]["test"]["spp"],
        "definitions": DEFINITIONS,
        "pictures": pictures,
        "test": dataset_errors(materials, data),
        "offsets": offsets,
        "seconds": {k: round(v, 3) for k, v in seconds.items()},
    }
    if section.unmodified_mitsuba:
        record["unmodified_mitsuba"] = write_agreement(section, generate, material, white, out)
    if section.timing:
        record["timing"] = _timings(fits)
    write_json(out / COMPARISON_NAME, record)
    return record


def _timings(fits: Mapping[str, Path]) -> dict[str, list[dict[str, Any]]]:
    """Times of every fit on the CPU and, if available, on the GPU."""
    import torch

    from mbtf_fit import Material

    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    return {
        name: [measure_timing(Material.load(folder, d), _TIMED_PIXELS, d) for d in devices]
        for name, folder in fits.items()
    }


def _render_references(
    section: CompareSection, estimator: Estimator, progress: Progress
) -> list[tuple[Scene, dict[PixelKind, ReferenceImage]]]:
    """References by scene and kind, the query kind first."""
    from mbtf_gen.pictures.reference import render_reference

    kinds = sorted(section.kinds, key=lambda kind: kind != "query")
    out = []
    for scene in scenes(section):
        images: dict[PixelKind, ReferenceImage] = {}
        for kind in kinds:
            images[kind] = render_reference(
                estimator,
                scene.camera(section.size),
                from_angles(scene.light.elevation, scene.light.azimuth),
                kind=kind,
                spp=section.spp,
                seed=section.seed,
                index=scene.index,
            )
            progress(f"reference {scene.name}")
        out.append((scene, images))
    return out


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
    from mbtf_core.lattice import level_of_sigma
    from mbtf_core.stats import mse_difference, pooled_relative_error

    record: dict[str, Any] = scene.describe()
    record["references"] = {}
    for kind, image in images.items():
        file = scene.file(reference_name(image.kind))
        image.write(out / file, 1.0 / white)
        noise = pooled_relative_error(image.value_a.reshape(-1, 3), image.value_b.reshape(-1, 3))
        record["references"][kind] = {"file": file, "noise": noise.as_dict()}
    if len(images) == 2:
        query, pixel = images["query"], images["pixel"]
        between = reference_difference((query.value_a, query.value_b), pixel.value_a, pixel.value_b)
        record["between_references"] = between.as_dict()
    main_kind, main = next(iter(images.items()))
    baseline = perceptual_scores(main.value_a, main.value_b, white, with_st_lpips=with_st_lpips)
    record["references"][main_kind] |= baseline.as_dict()
    queries = main.queries
    level = level_of_sigma(queries.sigma)
    record["levels"] = [round(float(level.min()), 3), round(float(level.max()), 3)]
    record["fits"] = {}
    values: list[F32] = []
    for name, material in materials.items():
        flat = queries.flat()
        evaluate = partial(material.evaluate, flat.u, flat.sigma, flat.omega_i, flat.omega_o)
        flat_value, seconds = timed(evaluate)
        value = np.asarray(flat_value, np.float32).reshape(*queries.lead, 3)
        file = scene.file(fit_name(name))
        write_picture(out / file, value)
        write_preview(out / file, value, white)
        scores = perceptual_scores(value, main.value, white, with_st_lpips=with_st_lpips)
        write_map(out / file, scores.flip.hdr_map)
        record["fits"][name] = {
            "file": file,
            "seconds": round(seconds, 4),
            "errors": {
                kind: image_errors(value, image.value_a, image.value_b).as_dict(white)
                for kind, image in images.items()
            },
            **scores.as_dict(),
        }
        if values:
            halves = [x.reshape(-1, 3) for x in (main.value_a, main.value_b)]
            difference = mse_difference(value.reshape(-1, 3), values[0].reshape(-1, 3), *halves)
            record["fits"][name]["mse_minus_first"] = difference.as_dict()
        values.append(value)
        progress(f"{name} {scene.name}")
    return record
