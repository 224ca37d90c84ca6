"""Error at equal training time: the models on eleven materials, and what each part of a model contributes.

    python benchmarks/front.py --out FOLDER [MATERIAL ...] [--time 30s] [--seeds 5]
    python benchmarks/front.py --out FOLDER --ablation relief|neumip+ [MATERIAL] [--time 30s]
    python benchmarks/front.py --out FOLDER --rock-cliff [--time 100s]

For each material, all models are trained on the same data, 128 texels across, 400 queries of 4 paths per
texel, of five assets and six texture sets. Test queries have 256 paths, and three quarters of them are drawn
by the highlights. All networks have the same width; ``relief`` traces one, two, four or sixteen view rays per
footprint, sixteen also with shadow rays; on cloth, measured where it is named, ``cloth`` takes its place. On
the materials of Kuznetsov et al. 2021, ``neumip-baseline`` is trained as well. ``--ablation`` leaves out one
part of a model at a time, on one material (``rock_cliff`` by default). ``--rock-cliff`` is the benchmark
``rock_cliff-128``: models of default sizes, a larger ``neumip`` and the baseline, on the data of
``pipelines/rock_cliff.yaml``.

Training rates are measured first, in turns; nothing else should use the processors then. Fits get the steps
that the time allows at these rates. FOLDER keeps data, rates and errors, so the same command resumes.

The last line is one JSON object. Thresholds: the unexplained variance of ``relief`` over that of ``neumip``
is at most 0.6 on displaced materials and at most 1 elsewhere (two standard errors).
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from statistics import mean, median, stdev
from typing import Any

from common import (
    CLOTHS,
    HEIGHT_SCALES,
    RELIEFS,
    ROOT,
    finish,
    is_available,
    kept,
    parser_of,
    processor,
    start,
)
from quality import generator_config

from mbtf_core.config.settings import deep_merge, resolve
from mbtf_core.data.dataset import Dataset
from mbtf_core.files.atomic import read_json
from mbtf_core.stats import Estimate, ratio_of
from mbtf_core.units import parse_duration
from mbtf_fit import FitConfig, fit
from mbtf_gen.generation.run import generate
from mbtf_pipeline.collection.recipes import PaperRecipe, first_known
from mbtf_pipeline.recipe import load_recipe

RESOLUTION = 128
# Training queries; test queries, and the share of these that highlights draw.
QUERIES = {"train": "400/texel", "spp": 4, "test_spp": 256, "test_highlights": 0.75}
# Training time in which a rate is measured, and how often. The first steps of ``neumip+``, which trace its
# heights, take seconds.
RATE_TIME, RATE_TURNS = "20s", 3
NEUMIP: dict[str, Any] = {
    "model": "neumip",
    "network": {"width": 40, "channels": 12, "encoding": {"direction_xyz": True}},
    "training": {"texture_weight_decay": 1.0, "blur": {"min_sigma": 0.8}},
}
BASELINE: dict[str, dict[str, Any]] = {"neumip-baseline": {**NEUMIP, "model": "neumip-baseline"}}
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
        "two rays": {"relief": {"places": 2}},
        "four rays": {"relief": {"places": 4}},
        "eight rays": {"relief": {"places": 8}},
        "sixteen rays": {"relief": {"places": 16}},
        "sixteen rays, shadow rays": {"relief": {"places": 16, "shadow_rays": True}},
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
    **{
        rays: deep_merge(RELIEF, {"network": PARTS["relief"][rays]})
        for rays in ("two rays", "four rays", "sixteen rays", "sixteen rays, shadow rays")
    },
}
# On cloth, by the same labels.
CLOTH_MODELS = {
    label: {**o, "model": "cloth"} if o["model"] == "relief" else o for label, o in MODELS.items()
}
THRESHOLDS = {"displaced": 0.6, "any": 1.0}
STANDARD_ERRORS = 2.0
# Displacement range in tile widths from which a material counts as displaced.
DISPLACED = 0.01

# Recipe with the published errors; of the benchmark.
PAPER, ROCK_CLIFF = (ROOT / "pipelines" / f"{name}.yaml" for name in ("paper_methods", "rock_cliff"))
# Models of the benchmark, and their most unexplained variance.
BENCHMARK: dict[str, tuple[dict[str, Any], float | None]] = {
    "relief": ({"model": "relief"}, 0.10),
    "relief, two rays": ({"model": "relief", "network": {"relief": {"places": 2}}}, 0.065),
    "relief, four rays": ({"model": "relief", "network": {"relief": {"places": 4}}}, 0.055),
    "neumip": ({"model": "neumip"}, 0.30),
    "neumip-baseline": ({"model": "neumip-baseline"}, None),
    "neumip-wide": (NEUMIP, 0.20),
}
# Least error of the baseline over that of neumip.
OVER_NEUMIP = 1.2


def shards(name: str, folder: Path) -> Path:
    """Data of a material, generated where they are missing."""
    out = folder / name / "shards"
    generate(generator_config(name, "draft", RESOLUTION, **QUERIES), out)
    return out


def steps_of(models: dict[str, dict[str, Any]], data: Path, folder: Path, time: str) -> dict[str, int]:
    """Steps of each model in a training time, at the rates that are kept in a folder."""
    batch, seconds = FitConfig().training.batch, parse_duration(time)

    def rates() -> dict[str, Any]:
        found: dict[str, list[float]] = {label: [] for label in models}
        for _ in range(RATE_TURNS):
            for label, options in models.items():
                config = FitConfig.model_validate(deep_merge(options, {"training": {"time": RATE_TIME}}))
                record = fit(config, data, folder / "rate", overwrite=True).history[-1]
                found[label].append(record["queries_per_second"])
        return {"processor": processor(), "rates": {label: median(each) for label, each in found.items()}}

    path = folder / "rates.json"
    if path.exists() and not models.keys() <= read_json(path)["rates"].keys():
        path.unlink()  # of another list of models
    measured = kept(path, rates)
    print(f"queries per second, {measured['processor']}: {measured['rates']}")
    return {label: round(seconds * rate / batch) for label, rate in measured["rates"].items()}


def train(
    label: str, options: dict[str, Any], data: Path, folder: Path, steps: int, seeds: int
) -> dict[str, Any]:
    """Errors of the fits of each seed, and their mean; each is kept in a folder."""
    fits = []
    for seed in range(seeds):
        name = f"{re.sub('[^a-z0-9+]+', '-', label)}-{steps}-{seed}"

        def measure(name: str = name, seed: int = seed) -> dict[str, Any]:
            config = FitConfig.model_validate(
                deep_merge(options, {"seed": seed, "training": {"steps": steps}})
            )
            result = fit(config, data, folder / name, overwrite=True)
            test = result.errors["test"]
            levels = {level: errors["unexplained"]["value"] for level, errors in test["levels"].items()}
            return {**test["unexplained"], "levels": levels}

        fits.append(kept(folder / f"{name}.json", measure))
    values = [each["value"] for each in fits]
    error = stdev(values) / math.sqrt(seeds) if seeds > 1 else fits[0]["error"]
    levels = {
        level: None if value is None else mean(each["levels"][level] for each in fits)
        for level, value in fits[0]["levels"].items()
    }
    found = {"value": mean(values), "error": error, "levels": levels, "steps": steps, "seeds": values}
    texts = " ".join("-" if value is None else f"{value:.3f}" for value in levels.values())
    print(
        f"{folder.name:16s} {label:30s} {steps:6d} steps  {found['value']:.3f} ± {error:.3f}   "
        f"by level {texts}",
        flush=True,
    )
    return found


def over(a: dict[str, Any], b: dict[str, Any]) -> tuple[float, float]:
    """Error of a fit over that of another, and its standard error."""
    ratio = ratio_of(*(Estimate(one["value"], one["error"], len(one["seeds"])) for one in (a, b)))
    return ratio.value, ratio.error


def compared(name: str, folder: Path, steps: dict[str, int], seeds: int) -> dict[str, Any]:
    """All models on one material."""
    data = shards(name, folder)

    def fits_of(models: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
        return {
            label: train(label, o, data, folder / name, steps[label], seeds) for label, o in models.items()
        }

    fits = fits_of(CLOTH_MODELS if name in CLOTHS else MODELS)
    ratio, error = over(fits["relief"], fits["neumip"])
    extent = Dataset.open(data).manifest["tile"]["displacement_range"]
    limit = THRESHOLDS["displaced" if extent >= DISPLACED else "any"]
    found = {"material": name, "displacement_range": extent, "fits": fits, "ratio": ratio, "error": error}
    sources = resolve(PaperRecipe, file=PAPER).published
    published, _ = first_known(sources, lambda p: p.mse_ratio(name, "neumip", "neumip-baseline"))
    if published is not None:
        plain = fits_of(BASELINE)["neumip-baseline"]
        ratios = {label: over(one, plain) for label, one in fits.items()}
        found["over_baseline"] = {"published neumip": published, "ratios": ratios}
        texts = "   ".join(f"{label} {value:.2f} ± {bar:.2f}" for label, (value, bar) in ratios.items())
        print(f"{name:16s} over neumip-baseline: {texts}   published for neumip {published:.2f}")
    for label in list(MODELS)[1:]:
        value, bar = over(fits[label], fits["neumip"])
        print(f"{name:16s} {label} over neumip {value:.2f} ± {bar:.2f}", flush=True)
    return {**found, "met": ratio - STANDARD_ERRORS * error <= limit}


def ablation(model: str, name: str, out: Path, time: str, seeds: int) -> int:
    """One model without one of its parts at a time."""
    data, folder = shards(name, out), out / name / model
    changed = {
        label: deep_merge(MODELS[model], {"network": change}) for label, change in PARTS[model].items()
    }
    steps = steps_of(changed, data, folder, time)
    fits = {label: train(label, o, data, folder, steps[label], seeds) for label, o in changed.items()}
    return finish({"material": name, "fits": fits}, {}, None)


def rock_cliff(out: Path, time: str, seeds: int) -> int:
    """The benchmark ``rock_cliff-128``."""
    data = out / "shards"
    generate(load_recipe(ROCK_CLIFF).generate, data)
    steps = steps_of({label: options for label, (options, _) in BENCHMARK.items()}, data, out, time)
    found = {
        label: train(label, options, data, out, steps[label], seeds)
        for label, (options, _) in BENCHMARK.items()
    }
    ratio = found["neumip-baseline"]["value"] / found["neumip"]["value"]
    limits = {label: limit for label, (_, limit) in BENCHMARK.items() if limit is not None}
    met = all(found[label]["value"] <= limit for label, limit in limits.items()) and ratio >= OVER_NEUMIP
    figures = {"fits": found, "baseline over neumip": ratio}
    return finish(figures, {**limits, "baseline over neumip": OVER_NEUMIP}, met)


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("materials", nargs="*")
    parser.add_argument("--out", type=Path, required=True, help="folder of data and figures")
    parser.add_argument("--time", help="training time; 30s, of rock_cliff 100s")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--ablation", choices=PARTS, help="model whose parts are left out")
    parser.add_argument("--rock-cliff", action="store_true", help="the benchmark rock_cliff-128")
    arguments = parser.parse_args()
    out, seeds = arguments.out, arguments.seeds
    if arguments.rock_cliff:
        return rock_cliff(out / "rock_cliff-128", arguments.time or "100s", seeds)
    time = arguments.time or "30s"
    if arguments.ablation:
        return ablation(arguments.ablation, (arguments.materials or ["rock_cliff"])[0], out, time, seeds)
    names = [n for n in arguments.materials or [*RELIEFS, *HEIGHT_SCALES] if is_available(n)]
    found = []
    for cloth, models, folder in ((False, MODELS, out), (True, CLOTH_MODELS, out / "cloth")):
        if group := [name for name in names if (name in CLOTHS) == cloth]:
            steps = steps_of({**models, **BASELINE}, shards(group[0], out), folder, time)
            found += [compared(name, out, steps, seeds) for name in group]
    return finish(found, THRESHOLDS, bool(found) and all(one["met"] for one in found))


if __name__ == "__main__":
    start(main)
