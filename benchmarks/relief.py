"""``relief`` and ``neumip+`` against ``neumip``: error at equal training time, and what each part is worth.

    python benchmarks/relief.py --out FOLDER [MATERIAL ...] [--time 60s] [--seed 0]
    python benchmarks/relief.py --out FOLDER --ablation relief|neumip+ [MATERIAL] [--time 30s]

For each material, all models are trained for the same time on the same data: those of the preset ``draft``
at 128 texels across, of the five ``assets/`` and of six texture sets that lie beside the project. Test
queries have 256 paths: with fewer, the noise of highlights hides the differences. The models have the
networks of ``draft``, of the same width; ``relief`` is also trained with four places. ``neumip+`` learns
heights, without the geometry. On the materials of Kuznetsov et al. 2021, ``neumip-baseline`` is trained, too,
for the ratios that they published. ``--ablation`` leaves out one part of a model at a time, on one material
(``rock_cliff`` by default). FOLDER keeps data and figures, so the same command resumes.

The last line is one JSON object with the figures and their thresholds: the unexplained variance of the test
queries over that of ``neumip`` is at most 0.6 on displaced materials, and nowhere above 1 by more than two
standard errors. Exit code 1 where a threshold is exceeded. Nothing else should use the processors.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from pathlib import Path
from typing import Any

from quality import HEIGHT_SCALES, ROOT, generator_config, source

from mbtf_core.atomic import read_json, write_json
from mbtf_core.nested import deep_merge
from mbtf_fit import FitConfig, fit
from mbtf_gen.dataset.reader import Dataset
from mbtf_gen.generation import generate
from mbtf_pipeline.papers.plan import load_paper_recipe
from mbtf_pipeline.papers.published import mse_ratio

# Recipe with the published errors.
PAPER = Path(__file__).parents[1] / "pipelines" / "paper_methods.yaml"
RESOLUTION = 128
# Paths per test query.
TEST_SPP = 256
NEUMIP: dict[str, Any] = {
    "model": "neumip",
    "network": {"width": 40, "channels": 12, "encoding": {"direction_xyz": True}},
    "training": {"texture_weight_decay": 1.0, "blur": {"min_sigma": 0.8}},
}
BASELINE: dict[str, Any] = {**NEUMIP, "model": "neumip-baseline"}
RELIEF: dict[str, Any] = {"model": "relief", "network": {"width": 40, "channels": 8}}
LEARNED: dict[str, Any] = {"model": "neumip+", "network": {"width": 40, "channels": 12}}
# What an ablation changes in the network, by model.
COMMON: dict[str, dict[str, Any]] = {
    "no hints": {"relief": {"hints": False}},
    "no known frame": {"relief": {"frame": False}},
    "no half and difference vector": {"encoding": {"half_vector": False}},
    "tracing alone": {
        "relief": {"gate": False, "hints": False, "frame": False},
        "encoding": {"half_vector": False},
        "oversampling": 1,
    },
}
PARTS: dict[str, dict[str, dict[str, Any]]] = {
    "relief": {
        "relief": {},
        "two places": {"relief": {"places": 2}},
        "four places": {"relief": {"places": 4}},
        "no gate": {"relief": {"gate": False}},
        "no oversampling": {"oversampling": 1},
        **COMMON,
    },
    "neumip+": {"neumip+": {}, **{f"neumip+, {part}": change for part, change in COMMON.items()}},
}
MODELS: dict[str, dict[str, Any]] = {
    "neumip": NEUMIP,
    "neumip+": LEARNED,
    "relief": RELIEF,
    "four places": deep_merge(RELIEF, {"network": PARTS["relief"]["four places"]}),
}
THRESHOLDS = {"displaced": 0.6, "any": 1.0}
STANDARD_ERRORS = 2.0
# Displacement range in tile widths from which a material counts as displaced.
DISPLACED = 0.01


def shards(name: str, folder: Path) -> Path:
    """Data of a material, generated where they are missing."""
    out = folder / name / "shards"
    config = generator_config(name, "draft", RESOLUTION)
    queries = config.queries.model_copy(update={"test_spp": TEST_SPP})
    generate(config.model_copy(update={"queries": queries}), out)
    return out


def train(
    label: str, options: dict[str, Any], data: Path, folder: Path, time: str, seed: int
) -> dict[str, Any]:
    """Error of one fit; kept in a folder."""
    name = fit_name(label, time, seed)
    path = folder / f"{name}.json"
    if path.exists():
        return read_json(path)
    config = FitConfig.model_validate(deep_merge(options, {"seed": seed, "training": {"time": time}}))
    result = fit(config, data, folder / name, overwrite=True)
    test = result.errors["test"]
    found = {
        **test["unexplained"],
        "levels": {level: errors["unexplained"]["value"] for level, errors in test["levels"].items()},
        "queries_per_second": round(result.history[-1]["queries_per_second"]),
    }
    write_json(path, found)
    levels = " ".join(f"{value:.3f}" for value in found["levels"].values())
    print(
        f"{folder.name:14s} {label:30s} {found['value']:.3f} ± {found['error']:.3f}   by level {levels}",
        file=sys.stderr,
        flush=True,
    )
    return found


def fit_name(label: str, time: str, seed: int) -> str:
    """Folder of a fit, in that of its material."""
    return f"{re.sub('[^a-z+]+', '-', label)}-{time}-{seed}"


def ratio_of(a: dict[str, Any], b: dict[str, Any]) -> tuple[float, float]:
    """Error of a fit over that of another, and its standard error."""
    ratio = a["value"] / b["value"]
    return ratio, ratio * math.hypot(a["error"] / a["value"], b["error"] / b["value"])


def compared(name: str, folder: Path, time: str, seed: int) -> dict[str, Any]:
    """All models on one material."""
    data = shards(name, folder)
    fits = {label: train(label, o, data, folder / name, time, seed) for label, o in MODELS.items()}
    ratio, bar = ratio_of(fits["relief"], fits["neumip"])
    extent = Dataset.open(data).manifest["tile"]["displacement_range"]
    limit = THRESHOLDS["displaced" if extent >= DISPLACED else "any"]
    paper = load_paper_recipe(PAPER, [])
    published = mse_ratio(paper.published, name, "neumip", "neumip-baseline")
    over_baseline = {}
    if published is not None:
        plain = train("neumip-baseline", BASELINE, data, folder / name, time, seed)
        ratios = {label: ratio_of(one, plain) for label, one in fits.items()}
        over_baseline = {"neumip-baseline": plain, "published neumip": published[0], "ratios": ratios}
    return {
        "material": name,
        "fits": fits,
        "ratio": ratio,
        "ratio_error": bar,
        "displacement_range": extent,
        "over_baseline": over_baseline,
        "met": ratio - STANDARD_ERRORS * bar <= limit,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("materials", nargs="*")
    parser.add_argument("--out", type=Path, required=True, help="folder of data and figures")
    parser.add_argument("--time", default="60s", help="training time of each fit")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--ablation", choices=PARTS, help="model whose parts are left out")
    arguments = parser.parse_args()
    if arguments.ablation:
        name = (arguments.materials or ["rock_cliff"])[0]
        folder = arguments.out / name
        data = shards(name, arguments.out)
        figures = {}
        for label, change in PARTS[arguments.ablation].items():
            options = deep_merge(MODELS[arguments.ablation], {"network": change})
            figures[label] = train(label, options, data, folder, arguments.time, arguments.seed)
        print(json.dumps({"material": name, "figures": figures}))
        return 0
    assets = sorted(path.parent.name for path in (ROOT / "assets").glob("*/height.*"))
    found = []
    for name in arguments.materials or [*assets, *HEIGHT_SCALES]:
        if not source(name)[0].is_dir():
            print(f"{name}: skipped, {source(name)[0]} is missing", file=sys.stderr)
            continue
        one = compared(name, arguments.out, arguments.time, arguments.seed)
        found.append(one)
        errors = "   ".join(f"{k} {fit['value']:.3f} ± {fit['error']:.3f}" for k, fit in one["fits"].items())
        print(
            f"{name:16s} {errors}   relief over neumip {one['ratio']:.2f} ± {one['ratio_error']:.2f}   "
            f"displacement range {one['displacement_range']:.3f}",
            flush=True,
        )
        if over := one["over_baseline"]:
            ratios = "   ".join(f"{k} {ratio:.2f} ± {bar:.2f}" for k, (ratio, bar) in over["ratios"].items())
            published = f"published for neumip {over['published neumip']:.2f}"
            print(f"{'':16s} over neumip-baseline: {ratios}   {published}", flush=True)
    met = bool(found) and all(one["met"] for one in found)
    print(json.dumps({"figures": found, "thresholds": THRESHOLDS, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
