"""Are the error bars of a cost study honest? Its configurations measured again with other seeds.

    python benchmarks/cost_repeat.py [--recipe pipelines/quickstart.yaml] [--seconds 2] [--seeds 2]
    python benchmarks/cost_repeat.py --studies FOLDER FOLDER

The first measures every configuration of the generator with each seed: other queries, paths and references.
The second compares two finished studies of one recipe and time with different seeds (``mbtf-pipeline cost
--seed 100``; a study uses up to 11 seeds after its own). Sizes of data follow from measured times, which
differ between studies, so runs of a series are matched by their order. With correct error bars, 90 % of the
differences lie within 1.65 of their standard errors.

The first also measures noise and bias of one-interaction paths over their number, with independent random
numbers in place of low-discrepancy points: the noise variance falls as one over the number of paths, and the
bias does not change.

The last line is one JSON object with the figures and their thresholds. Exit code 1 where one is missed.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import sys
from collections import defaultdict
from itertools import combinations
from pathlib import Path
from typing import Any

from error_per_second import independent_points

from mbtf_core.errors import MbtfError
from mbtf_core.stats import Estimate
from mbtf_gen.material.load import load_material
from mbtf_gen.render.runtime import load_mitsuba
from mbtf_pipeline.cost.generator_benchmark import GeneratorBenchmark
from mbtf_pipeline.cost.generator_runs import UNIFORM, generator_tasks
from mbtf_pipeline.cost.measurements import Measurement
from mbtf_pipeline.recipe import load_recipe

ROOT = Path(__file__).resolve().parents[1]
WITHIN = 1.65
EXPECTED = 0.9
# Largest deviation of the exponent of independent samples from -1, and of biases in standard errors.
EXPONENT = 0.1
BIASES = 3.0
# Paths of the biased configuration, and the configuration.
PATHS = (4, 16, 64)
BIASED = {**UNIFORM, "effects.mode": "all", "transport.max_depth": 1}
# Numbers of one study: by name and part, an estimate.
Rows = dict[tuple[str, str], Estimate]


def benchmark_of(recipe: Path, seed: int) -> GeneratorBenchmark:
    """The generator of a recipe with another seed."""
    config = load_recipe(recipe).generate
    material = load_material(Path(config.material), config.geometry.make_tileable)
    return GeneratorBenchmark(config.model_copy(update={"seed": seed}), material)


def measure(recipe: Path, seed: int, seconds: float) -> list[Measurement]:
    """All configurations of the generator with one seed."""
    benchmark = benchmark_of(recipe, seed)
    found = []
    for task in generator_tasks(benchmark):
        print(f"seed {seed}: {task.label}", file=sys.stderr)
        found.append(task.run(benchmark, seconds))
    return found


def rows_of(found: list[Measurement]) -> Rows:
    """Bias and noise of measured configurations."""
    return {
        (m.label, part): e
        for m in found
        for part, e in (("noise", m.noise), ("bias", m.bias))
        if e is not None
    }


def stored_rows(folder: Path) -> Rows:
    """Numbers of a finished study from its CSV; runs are numbered within their series."""
    out: Rows = {}
    numbers: defaultdict[str, int] = defaultdict(int)
    with (folder / "cost.csv").open(encoding="utf-8", newline="") as stream:
        for line in csv.DictReader(stream):
            series = f"{line['study']} {line['series']}"
            is_run = bool(line["total_seconds"])
            name = f"{series} {numbers[series] if is_run else line['name']}"
            numbers[series] += 1
            for part in ("error",) if is_run else ("noise", "bias"):
                if line[part] and line[f"{part}_se"]:
                    out[name, "runs" if is_run else part] = Estimate(
                        float(line[part]), float(line[f"{part}_se"]), 1
                    )
    return out


def normalized(a: Estimate, b: Estimate) -> float | None:
    """Difference over its standard error; None where that is zero or unknown."""
    error = math.hypot(a.error, b.error)
    return abs(a.value - b.value) / error if error > 0 and math.isfinite(error) else None


def independent(recipe: Path, seconds: float) -> tuple[Estimate, dict[int, Estimate]]:
    """With independent random numbers: power of the number of paths with which the noise variance changes,
    and the squared biases by number of paths."""
    import mbtf_gen.render.estimator as module

    benchmark = benchmark_of(recipe, 0)
    usual = module.sequence
    module.sequence = independent_points(usual)
    try:
        noises, biases = [], {}
        for n in PATHS:
            noises.append(benchmark.measure({**BIASED, "queries.spp": n}, None, seconds)[3])
            biases[n] = benchmark.bias(BIASED, {}, 2 * seconds, n)
            print(f"independent, {n} paths: noise {noises[-1]}, squared bias {biases[n]}")
    finally:
        module.sequence = usual
    few, many = noises[0], noises[-1]
    scale = 2.0 / math.log(PATHS[-1] / PATHS[0])
    power = scale * math.log(many.value / few.value)
    return Estimate(power, scale * math.hypot(few.relative_error, many.relative_error), 2), biases


def compare(studies: list[Rows]) -> dict[str, list[float]]:
    """Normalized differences between any two studies, by part."""
    differences: dict[str, list[float]] = {}
    for first, second in combinations(studies, 2):
        for key in first.keys() & second.keys():
            z = normalized(first[key], second[key])
            if z is not None:
                differences.setdefault(key[1], []).append(z)
                print(f"{key[0]:50s} {key[1]:5s} {first[key]} and {second[key]}: {z:.2f}")
    return differences


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--recipe", type=Path, default=ROOT / "pipelines" / "quickstart.yaml")
    parser.add_argument("--seconds", type=float, default=2.0, help="of each configuration's noise and bias")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--studies", type=Path, nargs=2, help="two finished studies")
    arguments = parser.parse_args()
    figures: dict[str, Any] = {}
    thresholds: dict[str, Any] = {}
    met = True
    try:
        if arguments.studies is not None:
            studies = [stored_rows(folder) for folder in arguments.studies]
        else:
            load_mitsuba()
            exponent, biases = independent(arguments.recipe, arguments.seconds)
            measured = [measure(arguments.recipe, s, arguments.seconds) for s in range(arguments.seeds)]
            studies = [rows_of(found) for found in measured]
            figures["independent_noise_exponent"] = exponent.as_dict()
            thresholds["independent_noise_exponent"] = [-1 - EXPONENT, -1 + EXPONENT]
            met &= abs(exponent.value + 1) <= EXPONENT
            figures["squared_bias_by_paths"] = {n: e.as_dict() for n, e in biases.items()}
            figures["bias_difference"] = z = normalized(biases[PATHS[0]], biases[PATHS[-1]])
            thresholds["bias_difference"] = BIASES
            met &= z is None or z <= BIASES
    except MbtfError as error:
        print(f"error: {error.message}", file=sys.stderr)
        return error.exit_code
    differences = compare(studies)
    every = [z for found in differences.values() for z in found]
    figures["within"] = {
        part: sum(z <= WITHIN for z in found) / len(found) for part, found in differences.items()
    }
    figures["differences"] = len(every)
    figures["all_within"] = together = sum(z <= WITHIN for z in every) / max(1, len(every))
    # Three standard deviations of a share of so many independent differences.
    tolerance = 3 * math.sqrt(EXPECTED * (1 - EXPECTED) / max(1, len(every)))
    thresholds["all_within"] = [EXPECTED - tolerance, EXPECTED + tolerance]
    met &= abs(together - EXPECTED) <= tolerance
    print(json.dumps({"figures": figures, "thresholds": thresholds, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
