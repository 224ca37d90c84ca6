"""The compare stage: references and fits at the same pixels, and the errors of both pictures and data."""

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
from mbtf_pipeline.compare.dataset_errors import errors_on_data
from mbtf_pipeline.compare.metrics import DEFINITIONS, Score, halves_score, score, white_point
from mbtf_pipeline.compare.offsets import write_offsets
from mbtf_pipeline.compare.perceptual_metrics import visible_difference
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
from mbtf_pipeline.compare.unmodified_mitsuba import pick_scene, write_stock
from mbtf_pipeline.recipe import CompareSection

if TYPE_CHECKING:
    from mbtf_fit import Material
    from mbtf_gen.pictures.camera import PixelKind
    from mbtf_gen.pictures.reference import ReferenceImage
    from mbtf_gen.render.estimator import Estimator

COMPARISON_NAME = "comparison.json"
COMPARISON_FORMAT = "mbtf-comparison"
# Raised when the record or what lies beside it changes; part of what the stage depends on.
COMPARISON_SCHEMA = 5

F32 = NDArray[np.float32]
Progress = Callable[[str], None]
# One query per pixel of 1080p is what timings are for.
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
    """Render, evaluate, measure; write everything into `out`.

    Parameters
    ----------
    generate : the material, its geometry, light and transport
    shards : data set whose test split the fits are measured on
    fits : name → folder of the fitted material
    out : folder; ``comparison.json`` is written last
    progress : called with what was just done

    Returns
    -------
    the content of ``comparison.json``
    """
    from mbtf_fit import Material
    from mbtf_gen.dataset.reader import Dataset
    from mbtf_gen.job import Job
    from mbtf_gen.material.material import load_material
    from mbtf_gen.planning.effects_plan import reference_plan
    from mbtf_gen.planning.simulation import build_estimator

    if section.st_lpips:
        require()
    if section.stock:
        pick_scene(section)
    (out / PICTURES).mkdir(parents=True, exist_ok=True)
    materials = {name: Material.load(folder) for name, folder in fits.items()}
    start = time.perf_counter()
    material = load_material(Path(generate.material), generate.geometry.make_tileable)
    job = Job(generate, material)
    estimator = build_estimator(job, reference_plan(job))
    rendered = _render(section, estimator, progress)
    seconds = {"references": time.perf_counter() - start}
    # The white point is that of what is compared with; without a query reference, of what there is.
    white = white_point([next(iter(images.values())).value for _, images in rendered])
    start = time.perf_counter()
    learned = section.st_lpips
    pictures = [
        _picture(scene, images, materials, white, learned, out, progress) for scene, images in rendered
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
        "test": errors_on_data(materials, data),
        "offsets": offsets,
        "seconds": {k: round(v, 3) for k, v in seconds.items()},
    }
    if section.stock:
        record["stock"] = write_stock(section, generate, material, white, out)
    if section.timing:
        record["timing"] = _timings(fits)
    write_json(out / COMPARISON_NAME, record)
    return record


def _timings(fits: Mapping[str, Path]) -> dict[str, list[dict[str, Any]]]:
    """Times of every fit, on the processor and, where there is one, on the GPU."""
    import torch

    from mbtf_fit import Material

    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    return {
        name: [measure_timing(Material.load(folder, d), _TIMED_PIXELS, d) for d in devices]
        for name, folder in fits.items()
    }


def _render(
    section: CompareSection, estimator: Estimator, progress: Progress
) -> list[tuple[Scene, dict[PixelKind, ReferenceImage]]]:
    """All references by scene and kind, the query kind first."""
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


def _picture(
    scene: Scene,
    images: Mapping[PixelKind, ReferenceImage],
    materials: Mapping[str, Material],
    white: float,
    learned: bool,
    out: Path,
    progress: Progress,
) -> dict[str, Any]:
    """Write one scene's pictures and measure them."""
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
        between = halves_score((query.value_a, query.value_b), pixel.value_a, pixel.value_b)
        record["between_references"] = between.as_dict()
    main_kind, main = next(iter(images.items()))
    noise_alone = visible_difference(main.value_a, main.value_b, white, learned=learned)
    record["references"][main_kind] |= noise_alone.as_dict()
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
        errors: dict[str, Score] = {
            kind: score(value, image.value_a, image.value_b) for kind, image in images.items()
        }
        visible = visible_difference(value, main.value, white, learned=learned)
        write_map(out / file, visible.flip.hdr_map)
        record["fits"][name] = {
            "file": file,
            "seconds": round(seconds, 4),
            "errors": {kind: s.as_dict(white) for kind, s in errors.items()},
            **visible.as_dict(),
        }
        if values:
            halves = [x.reshape(-1, 3) for x in (main.value_a, main.value_b)]
            apart = mse_difference(value.reshape(-1, 3), values[0].reshape(-1, 3), *halves)
            record["fits"][name]["mse_less_first"] = apart.as_dict()
        values.append(value)
        progress(f"{name} {scene.name}")
    return record
