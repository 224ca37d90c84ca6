"""Are the error bars of a cost study honest? Its points, measured twice with other seeds.

    python benchmarks/cost_repeat.py [--recipe pipelines/quickstart.yaml] [--seconds 2] [--seeds 2]
    python benchmarks/cost_repeat.py --studies FOLDER FOLDER

The first measures every setting of the generator with each seed: other queries, other paths, another
reference. The second compares two finished studies of the same recipe and budget (``mbtf-pipeline cost …
--seed 100``; chains use up to 11 seeds more), whole chains included. Sizes of data follow from prices, which
differ a little between runs, so chains of *Queries or paths?* are matched in their order. Where the bars are
right, the differences over their combined standard errors lie within 1.65 nine times out of ten.

The first also measures, with independent random numbers in place of low-discrepancy points, how noise and
bias of paths that end at their first interaction change with the number of paths: the noise's variance falls
like its inverse, the bias stays.

The last line is one JSON object: figures, and the bars they are held to. Exit code 1 where a bar is missed.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import sys
from collections import Counter
from itertools import combinations
from pathlib import Path
from typing import Any

from error_per_second import independent_points

from mbtf_core.errors import MbtfError
from mbtf_core.stats import Estimate
from mbtf_gen.material.material import load_material
from mbtf_gen.planning.effects_plan import plan_effects
from mbtf_gen.planning.simulation import build_estimator
from mbtf_gen.render.runtime import load_mitsuba
from mbtf_pipeline.cost_study.fit_runs import PATH_SHARES
from mbtf_pipeline.cost_study.generator_benchmark import GeneratorBenchmark
from mbtf_pipeline.cost_study.generator_runs import generator_tasks
from mbtf_pipeline.cost_study.measurements import HALF_WIDTH, NORMAL, Point
from mbtf_pipeline.cost_study.page import paths_slope
from mbtf_pipeline.recipe import load_recipe

ROOT = Path(__file__).resolve().parents[1]
WITHIN = 1.65
EXPECTED = 0.9
# How far the slope of independent samples may lie from -1.
SLOPE = 0.1
# Paths of the biased setting, and the setting.
PATHS = (4, 16, 64)
BIASED = {"effects.mode": "all", "transport.max_depth": 1}
# A point's numbers by name: error of a chain, or bias and noise of a setting.
Row = tuple[str, dict[str, Estimate]]


def bench_of(recipe: Path, seed: int) -> GeneratorBenchmark:
    """The generator of a recipe with another seed."""
    config = load_recipe(recipe).generate
    material = load_material(Path(config.material), config.geometry.make_tileable)
    return GeneratorBenchmark(config.model_copy(update={"seed": seed}), material, seed)


def measure(recipe: Path, seed: int, seconds: float) -> list[Point]:
    """All points of the generator with one seed."""
    bench = bench_of(recipe, seed)
    points = []
    for task in generator_tasks(bench):
        points.append(task.run(bench, seconds))
        print(f"seed {seed}: {task.study} {task.name}", file=sys.stderr)
    return points


def rows_of(points: list[Point]) -> list[Row]:
    """Bias and noise of measured points."""
    parts = [{"noise": p.noise, "bias": p.bias} for p in points]
    return [
        (f"{p.study} {p.series} {p.name}", {k: e for k, e in part.items() if e is not None})
        for p, part in zip(points, parts, strict=True)
    ]


def stored_rows(folder: Path) -> list[Row]:
    """Points of a finished study, from its CSV; those whose names hold sizes of data are numbered in their
    order, of series where none is missing."""
    with (folder / "cost.csv").open(encoding="utf-8", newline="") as stream:
        lines = [r for r in csv.DictReader(stream) if r["study"] != "seeds"]
    sized = Counter(line["series"] for line in lines if line["study"] == "data")
    numbers: Counter[str] = Counter()
    out = []
    for line in lines:
        series, name = line["series"], line["name"]
        if line["study"] == "data":
            if sized[series] != len(PATH_SHARES):
                print(f"{folder}: {series} left out, sizes of data are missing", file=sys.stderr)
                continue
            name = f"size {numbers[series]}"
            numbers[series] += 1
        whole = bool(line["total_seconds"])
        found = {}
        for part in ("error",) if whole else ("noise", "bias"):
            if line[part] and line[f"{part}_se"]:
                found["chain" if whole else part] = Estimate(float(line[part]), float(line[f"{part}_se"]), 1)
        out.append((f"{line['study']} {series} {name}", found))
    return out


def normalized(a: Estimate, b: Estimate) -> float | None:
    """Difference over its standard error; None where nothing was to be told."""
    scatter = math.hypot(a.error, b.error)
    return abs(a.value - b.value) / scatter if scatter > 0 and math.isfinite(scatter) else None


def independent(recipe: Path, seconds: float) -> tuple[Estimate | None, dict[int, Estimate]]:
    """Slope of the noise's variance over the number of independent paths, and by number of paths the squared
    bias of a biased setting."""
    import mbtf_gen.render.estimator as module

    bench = bench_of(recipe, 0)
    usual = module.sequence
    module.sequence = independent_points(usual)
    try:
        points, biases = [], {}
        for n in PATHS:
            found = bench.measure({**BIASED, "queries.spp": n}, None, seconds)
            setting = {"queries.spp": n}
            points.append(Point("paths", "", "", setting, "", found.seconds, found.error, None, found.noise))
            job = bench.job(BIASED)
            biases[n] = bench.bias(build_estimator(job, plan_effects(job)), {}, 2 * seconds, n)
            print(f"independent, {n} paths: noise {found.noise}, squared bias {biases[n]}")
    finally:
        module.sequence = usual
    return paths_slope(points), biases


def compare(runs: list[list[Row]]) -> dict[str, list[float]]:
    """Normalized differences between any two runs, by part."""
    differences: dict[str, list[float]] = {}
    for first, second in combinations(runs, 2):
        others = dict(second)
        for name, parts in first:
            for part, x in parts.items():
                y = others.get(name, {}).get(part)
                z = normalized(x, y) if y is not None else None
                if z is not None:
                    differences.setdefault(part, []).append(z)
                    print(f"{name:50s} {part:5s} {x} against {y}: {z:.2f}")
    return differences


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--recipe", type=Path, default=ROOT / "pipelines" / "quickstart.yaml")
    parser.add_argument("--seconds", type=float, default=2.0, help="spent on each setting's noise and bias")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--studies", type=Path, nargs=2, help="two finished studies, in place of measuring")
    arguments = parser.parse_args()
    figures: dict[str, Any] = {}
    bars: dict[str, Any] = {}
    met = True
    try:
        if arguments.studies is not None:
            runs = [stored_rows(folder) for folder in arguments.studies]
        else:
            load_mitsuba()
            slope, biases = independent(arguments.recipe, arguments.seconds)
            measured = [measure(arguments.recipe, s, arguments.seconds) for s in range(arguments.seeds)]
            runs = [rows_of(points) for points in measured]
            slopes = [s for points in measured if (s := paths_slope(points)) is not None]
            figures["noise_variance_slopes"] = [s.value for s in slopes]
            if slope is not None:
                figures["independent_noise_variance_slope"] = slope.as_dict()
                bars["independent_noise_variance_slope"] = [-1 - SLOPE, -1 + SLOPE]
                met &= abs(slope.value + 1) <= SLOPE
            few, many = biases[PATHS[0]], biases[PATHS[-1]]
            figures["squared_bias_by_paths"] = {n: e.as_dict() for n, e in biases.items()}
            z = normalized(few, many)
            figures["bias_difference"] = z
            bars["bias_difference"] = 3.0
            met &= z is None or z <= 3.0
            print(f"slopes of the noise's variance: {', '.join(map(str, slopes))}; independent: {slope}")
    except MbtfError as error:
        print(f"error: {error.message}", file=sys.stderr)
        return error.exit_code
    differences = compare(runs)
    shares = {part: sum(z <= WITHIN for z in found) / len(found) for part, found in differences.items()}
    count = sum(map(len, differences.values()))
    together = sum(z <= WITHIN for found in differences.values() for z in found) / max(1, count)
    # Three standard deviations of a share of so many independent cases.
    tolerance = 3 * math.sqrt(EXPECTED * (1 - EXPECTED) / max(1, count))
    met &= abs(together - EXPECTED) <= tolerance
    widths = [
        NORMAL * e.relative_error
        for run in runs
        for _, parts in run
        for part, e in parts.items()
        if part != "bias" and e.value > 0
    ]
    narrow = sum(w <= HALF_WIDTH for w in widths)
    print(f"within {WITHIN}: {shares}, together {together:.2f} of {count}")
    print(f"half-widths of noise and chains: {narrow} of {len(widths)} within 10 %")
    figures |= {
        "within": shares,
        "together": together,
        "cases": count,
        "half_widths_within_a_tenth": narrow / max(1, len(widths)),
    }
    bars["together"] = [EXPECTED - tolerance, EXPECTED + tolerance]
    print(json.dumps({"figures": figures, "bars": bars, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
