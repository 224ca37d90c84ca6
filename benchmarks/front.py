"""Error against training time: the models on eleven materials, and what each part of a model contributes.

    python benchmarks/front.py --out FOLDER [MATERIAL ...] [--time 30s 2min] [--seed 0]
    python benchmarks/front.py --out FOLDER --ablation relief|neumip+ [MATERIAL] [--time 30s]
    python benchmarks/front.py --out FOLDER --rock-cliff [--time 100s]

For each material, all models are trained for the same times on the same data: those of the preset ``draft``
at 128 texels across, of five assets and six texture sets. Test queries have 256 paths: with fewer, the noise
of highlights hides the differences. All networks have the same width; ``relief`` also traces four view rays
per footprint, and ``neumip+`` learns heights without the geometry. On the materials of Kuznetsov et al. 2021,
``neumip-baseline`` is trained as well, for the ratios that they published. ``--ablation`` leaves out one part
of a model at a time, on one material (``rock_cliff`` by default). ``--rock-cliff`` is the benchmark
``rock_cliff-128``: models of their default sizes, a larger ``neumip`` and the baseline, on the data of
``pipelines/rock_cliff.yaml``, with thresholds of their unexplained variance. FOLDER keeps data and figures,
so the same command resumes. Nothing else should use the processors.

The last line is one JSON object. Thresholds hold for the longest time: the unexplained variance of ``relief``
over that of ``neumip`` is at most 0.6 on displaced materials and at most 1 elsewhere (two standard errors).
"""

from __future__ import annotations

import argparse
import math
import re
from pathlib import Path
from typing import Any

from common import HEIGHT_SCALES, RELIEFS, ROOT, finish, is_available, kept, parser_of, start
from quality import generator_config

from mbtf_core.config.settings import deep_merge, resolve
from mbtf_core.data.dataset import Dataset
from mbtf_fit import FitConfig, fit
from mbtf_gen.generation.run import generate
from mbtf_pipeline.collection.recipes import PaperRecipe, first_known
from mbtf_pipeline.recipe import load_recipe

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
        "two rays": {"relief": {"places": 2}},
        "four rays": {"relief": {"places": 4}},
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
    "four rays": deep_merge(RELIEF, {"network": PARTS["relief"]["four rays"]}),
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
    "relief, four rays": ({"model": "relief", "network": {"relief": {"places": 4}}}, 0.085),
    "neumip": ({"model": "neumip"}, 0.30),
    "neumip-baseline": ({"model": "neumip-baseline"}, None),
    "neumip-wide": (NEUMIP, 0.20),
}
# Least error of the baseline over that of neumip.
OVER_NEUMIP = 1.2


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
    name = f"{re.sub('[^a-z+]+', '-', label)}-{time}-{seed}"

    def measure() -> dict[str, Any]:
        config = FitConfig.model_validate(deep_merge(options, {"seed": seed, "training": {"time": time}}))
        result = fit(config, data, folder / name, overwrite=True)
        test = result.errors["test"]
        return {
            **test["unexplained"],
            "levels": {level: errors["unexplained"]["value"] for level, errors in test["levels"].items()},
            "steps": result.history[-1]["step"],
            "queries_per_second": round(result.history[-1]["queries_per_second"]),
        }

    found = kept(folder / f"{name}.json", measure)
    levels = " ".join("-" if value is None else f"{value:.3f}" for value in found["levels"].values())
    print(
        f"{folder.name:16s} {label:30s} {time:>6s} {found['steps']:6d} steps  "
        f"{found['value']:.3f} ± {found['error']:.3f}   "
        f"by level {levels}",
        flush=True,
    )
    return found


def ratio_of(a: dict[str, Any], b: dict[str, Any]) -> tuple[float, float]:
    """Error of a fit over that of another, and its standard error."""
    ratio = a["value"] / b["value"]
    return ratio, ratio * math.hypot(a["error"] / a["value"], b["error"] / b["value"])


def compared(name: str, folder: Path, times: list[str], seed: int) -> dict[str, Any]:
    """All models on one material, after each of the times."""
    data = shards(name, folder)

    def fits_of(models: dict[str, dict[str, Any]], time: str) -> dict[str, dict[str, Any]]:
        return {label: train(label, o, data, folder / name, time, seed) for label, o in models.items()}

    front = {time: fits_of(MODELS, time) for time in times}
    fits = front[times[-1]]
    ratio, error = ratio_of(fits["relief"], fits["neumip"])
    extent = Dataset.open(data).manifest["tile"]["displacement_range"]
    limit = THRESHOLDS["displaced" if extent >= DISPLACED else "any"]
    found = {"material": name, "displacement_range": extent, "fits": front, "ratio": ratio, "error": error}
    sources = resolve(PaperRecipe, file=PAPER).published
    published, _ = first_known(sources, lambda p: p.mse_ratio(name, "neumip", "neumip-baseline"))
    if published is not None:
        plain = fits_of({"neumip-baseline": BASELINE}, times[-1])["neumip-baseline"]
        ratios = {label: ratio_of(one, plain) for label, one in fits.items()}
        found["over_baseline"] = {"published neumip": published, "ratios": ratios}
        texts = "   ".join(f"{label} {value:.2f} ± {bar:.2f}" for label, (value, bar) in ratios.items())
        print(f"{name:16s} over neumip-baseline: {texts}   published for neumip {published:.2f}")
    print(f"{name:16s} relief over neumip {ratio:.2f} ± {error:.2f}", flush=True)
    return {**found, "met": ratio - STANDARD_ERRORS * error <= limit}


def ablation(model: str, name: str, arguments: argparse.Namespace) -> int:
    """One model without one of its parts at a time."""
    data, folder = shards(name, arguments.out), arguments.out / name
    figures = {}
    for label, change in PARTS[model].items():
        options = deep_merge(MODELS[model], {"network": change})
        figures[label] = train(label, options, data, folder, arguments.time[-1], arguments.seed)
    return finish({"material": name, "fits": figures}, {}, None)


def rock_cliff(out: Path, time: str, seed: int) -> int:
    """The benchmark ``rock_cliff-128``."""
    generate(load_recipe(ROCK_CLIFF).generate, out / "shards")
    found = {
        label: train(label, options, out / "shards", out, time, seed)
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
    parser.add_argument("--time", nargs="+", help="training times, the longest last; 60s, of rock_cliff 100s")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--ablation", choices=PARTS, help="model whose parts are left out")
    parser.add_argument("--rock-cliff", action="store_true", help="the benchmark rock_cliff-128")
    arguments = parser.parse_args()
    if arguments.rock_cliff:
        return rock_cliff(arguments.out / "rock_cliff-128", (arguments.time or ["100s"])[-1], arguments.seed)
    arguments.time = arguments.time or ["60s"]
    if arguments.ablation:
        return ablation(arguments.ablation, (arguments.materials or ["rock_cliff"])[0], arguments)
    names = [n for n in arguments.materials or [*RELIEFS, *HEIGHT_SCALES] if is_available(n)]
    found = [compared(name, arguments.out, arguments.time, arguments.seed) for name in names]
    return finish(found, THRESHOLDS, bool(found) and all(one["met"] for one in found))


if __name__ == "__main__":
    start(main)
