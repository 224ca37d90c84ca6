"""Contrast of pictures of ``relief``, ``neumip+`` and ``neumip`` beside path-traced ones, from near to far.

    python benchmarks/relief_pictures.py --out FOLDER [MATERIAL ...] [--time 60s] [--seed 0]

FOLDER is that of ``relief.py``, whose fits are used where they are, and trained where they are missing. Each
fit is compared with pixels of 0.5 to 32 tiles across, from above and from 16 degrees above the plane, by
contrast of luminance, contrast of chroma and correlation of chroma, and with values at texel centers,
quarters and corners. ``docs/how-to/read-the-report.md`` defines them. ``FOLDER/MATERIAL/pictures.png`` shows
all pictures: path-traced, then each fit.

The last line is one JSON object with the figures and their thresholds for ``relief``, each up to two standard
errors: luminance within 10 %, chroma at one tile across at least 0.9, places between texels within 5 %. Exit
code 1 where a threshold is exceeded.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from quality import HEIGHT_SCALES, ROOT, generator_config, source
from relief import MODELS, RESOLUTION, fit_name, shards, train

from mbtf_core.directions import from_angles
from mbtf_core.exposure import auto_exposure, brightness, to_display
from mbtf_fit import Material
from mbtf_gen.job import Job
from mbtf_gen.pictures.camera import Camera
from mbtf_gen.pictures.reference import render_reference, write_png
from mbtf_gen.planning.effects_planner import reference_plan
from mbtf_gen.planning.simulation import build_estimator
from mbtf_pipeline.compare.contrast import contrast, phase_contrasts, picture_blocks
from mbtf_pipeline.recipe import FIELD_OF_VIEW

WIDTHS = (0.5, 1.0, 2.0, 8.0, 32.0)
# Elevations of the view, and direction of the light, in degrees.
ELEVATIONS, LIGHT = (90.0, 16.0), (40.0, 30.0)
# Pixels as wide as texels at one tile across; at half a tile they are finer than the data.
SIZE, PATHS = RESOLUTION, 256
# Largest deviation of the contrast of luminance from 1, least contrast and correlation of chroma, largest
# deviation at places between texels.
THRESHOLDS = {"luminance": 0.1, "chroma": 0.9, "phase": 0.05}
STANDARD_ERRORS = 2.0


def measure(name: str, folder: Path, time: str, seed: int) -> dict[str, Any]:
    """Figures of all fits of a material."""
    data = shards(name, folder)
    materials = {}
    for label, options in MODELS.items():
        train(label, options, data, folder / name, time, seed)
        materials[label] = Material.load(folder / name / fit_name(label, time, seed))
    job = Job.load(generator_config(name, "draft", RESOLUTION))
    estimator = build_estimator(job, reference_plan(job))
    light = from_angles(*LIGHT)
    rows, strips = [], []
    for index, (elevation, width) in enumerate((e, w) for e in ELEVATIONS for w in WIDTHS):
        camera = Camera(elevation, -90.0, width, rows=SIZE, columns=SIZE, field_of_view=FIELD_OF_VIEW)
        image = render_reference(estimator, camera, light, kind="pixel", spp=PATHS, index=index)
        q = image.queries.flat()
        halves = [x.reshape(-1, 3) for x in (image.value_a, image.value_b)]
        strip = [image.value]
        for label, material in materials.items():
            value = material.evaluate(q.u, q.sigma, q.omega_i, q.omega_o)
            strip.append(value.reshape(image.value.shape))
            found = contrast(value, halves[0], halves[1], picture_blocks(SIZE, SIZE))
            figures = {key: e and e.as_dict() for key, e in found.items()}
            rows.append({"elevation": elevation, "tiles_across": width, "fit": label, **figures})
        strips.append(np.concatenate(strip, 1))
    half = len(WIDTHS)
    sheet = np.concatenate([np.concatenate(strips[:half]), np.concatenate(strips[half:])], 1)
    exposure = auto_exposure([brightness(sheet)])
    write_png(folder / name / "pictures.png", to_display(sheet, exposure))
    view = from_angles(ELEVATIONS[0], -90.0)
    phases = phase_contrasts(estimator, materials, job.lattice, light, view, 0)
    return {"material": name, "pictures": rows, "phases": phases}


def interval(estimate: Mapping[str, float | None] | None) -> tuple[float, float] | None:
    """Two standard errors about an estimate, where it has both."""
    value, error = (estimate["value"], estimate["error"]) if estimate else (None, None)
    if value is None or error is None:
        return None
    return value - STANDARD_ERRORS * error, value + STANDARD_ERRORS * error


def below(estimate: Mapping[str, float | None] | None, least: float) -> bool:
    found = interval(estimate)
    return found is not None and found[1] < least


def off(estimate: Mapping[str, float | None] | None, most: float) -> bool:
    found = interval(estimate)
    return found is not None and (found[0] > 1 + most or found[1] < 1 - most)


def faults(found: Mapping[str, Any], label: str = "relief") -> Iterable[str]:
    """What exceeds its threshold."""
    for row in found["pictures"]:
        where = f"{row['elevation']:g} degrees, {row['tiles_across']:g} tiles across"
        if row["fit"] != label:
            continue
        if off(row["luminance"], THRESHOLDS["luminance"]):
            yield f"luminance {row['luminance']['value']:.2f} at {where}"
        if row["tiles_across"] == 1:
            for key in ("chroma", "correlation"):
                if below(row[key], THRESHOLDS["chroma"]):
                    yield f"{key} {row[key]['value']:.2f} at {where}"
    for row in found["phases"]:
        if off(row["fits"][label], THRESHOLDS["phase"]):
            yield f"{row['fits'][label]['value']:.2f} at {row['phase']} of level {row['level']}"


def text(estimate: Mapping[str, float | None] | None) -> str:
    if estimate is None or estimate["value"] is None:
        return "–"
    error = "?" if estimate["error"] is None else f"{estimate['error']:.2f}"
    return f"{estimate['value']:.2f} ± {error}"


def show(found: Mapping[str, Any]) -> None:
    """Print the figures of a material."""
    for row in found["pictures"]:
        view = f"{row['elevation']:3g}° {row['tiles_across']:4g} tiles"
        figures = "   ".join(f"{key} {text(row[key])}" for key in ("luminance", "chroma", "correlation"))
        print(f"{found['material']:16s} {view}  {row['fit']:12s} {figures}")
    for row in found["phases"]:
        fits = "   ".join(f"{fit} {text(e)}" for fit, e in row["fits"].items())
        print(f"{found['material']:16s} level {row['level']} {row['phase']:9s} {fits}", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("materials", nargs="*")
    parser.add_argument("--out", type=Path, required=True, help="folder of relief.py")
    parser.add_argument("--time", default="60s", help="training time of each fit")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    assets = sorted(path.parent.name for path in (ROOT / "assets").glob("*/height.*"))
    out = []
    for name in arguments.materials or [*assets, *HEIGHT_SCALES]:
        if not source(name)[0].is_dir():
            print(f"{name}: skipped, {source(name)[0]} is missing", file=sys.stderr)
            continue
        found = measure(name, arguments.out, arguments.time, arguments.seed)
        show(found)
        out.append({**found, "faults": list(faults(found))})
        print(f"{name:16s} faults of relief: {'; '.join(out[-1]['faults']) or 'none'}", flush=True)
    met = bool(out) and not any(one["faults"] for one in out)
    print(json.dumps({"figures": out, "thresholds": THRESHOLDS, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
