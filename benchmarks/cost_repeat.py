"""Are the error bars of a cost study honest? Its generator points, measured twice with other seeds.

    python benchmarks/cost_repeat.py [--recipe pipelines/quickstart.yaml] [--seconds 2] [--seeds 2]

Every setting is measured with each seed: other queries, other paths, another reference. Where the bars are
right, the differences over their combined standard errors lie within 1.65 nine times out of ten, for noise
and for bias. Printed too: the slope of the noise's variance over the number of paths (-1 for independent
samples, steeper for low-discrepancy ones).

The last line is one JSON object: figures, and the bars they are held to. Exit code 1 where a bar is missed.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from itertools import combinations
from pathlib import Path

from mbtf_gen.errors import MbtfError
from mbtf_gen.material import load_material
from mbtf_gen.stats import Estimate
from mbtf_pipeline.cost.generator import Bench
from mbtf_pipeline.cost.generator_studies import generator_tasks
from mbtf_pipeline.cost.points import Point
from mbtf_pipeline.recipe import load_recipe

ROOT = Path(__file__).resolve().parents[1]
WITHIN = 1.65
EXPECTED = 0.9


def measure(recipe: Path, seed: int, seconds: float) -> list[Point]:
    """All points of the generator with one seed."""
    config = load_recipe(recipe).generate
    material = load_material(Path(config.material), config.geometry.tile)
    points = []
    bench = Bench(config.model_copy(update={"seed": seed}), material, seed)
    for task in generator_tasks(bench):
        points.append(task.run(bench, seconds))
        print(f"seed {seed}: {task.study} {task.name}", file=sys.stderr)
    return points


def normalised(a: Estimate, b: Estimate) -> float | None:
    """Difference over its standard error; None where nothing was to be told."""
    scatter = math.hypot(a.error, b.error)
    return abs(a.value - b.value) / scatter if scatter > 0 and math.isfinite(scatter) else None


def slope(points: list[Point]) -> float:
    """Power of the number of paths with which the noise's variance falls."""
    xs = [math.log(p.setting["queries.spp"]) for p in points]
    ys = [2 * math.log(p.noise.value) for p in points if p.noise is not None]
    mean_x, mean_y = sum(xs) / len(xs), sum(ys) / len(ys)
    return sum((x - mean_x) * (y - mean_y) for x, y in zip(xs, ys, strict=True)) / sum(
        (x - mean_x) ** 2 for x in xs
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--recipe", type=Path, default=ROOT / "pipelines" / "quickstart.yaml")
    parser.add_argument("--seconds", type=float, default=2.0, help="spent on each setting's noise and bias")
    parser.add_argument("--seeds", type=int, default=2)
    arguments = parser.parse_args()
    try:
        runs = [measure(arguments.recipe, seed, arguments.seconds) for seed in range(arguments.seeds)]
    except MbtfError as error:
        print(f"error: {error.message}", file=sys.stderr)
        return error.exit_code
    differences: dict[str, list[float]] = {"noise": [], "bias": []}
    for first, second in combinations(runs, 2):
        for a, b in zip(first, second, strict=True):
            for part, found in differences.items():
                x, y = getattr(a, part), getattr(b, part)
                z = normalised(x, y) if x is not None and y is not None else None
                if z is not None:
                    found.append(z)
                    print(f"{a.study:8s} {a.name:24s} {part:5s} {x} against {y}: {z:.2f}")
    shares = {
        part: sum(z <= WITHIN for z in found) / max(1, len(found)) for part, found in differences.items()
    }
    slopes = [slope([p for p in run if p.study == "paths"]) for run in runs]
    # Three standard deviations of a share of so many independent cases.
    count = sum(len(found) for found in differences.values())
    together = sum(z <= WITHIN for found in differences.values() for z in found) / max(1, count)
    tolerance = 3 * math.sqrt(EXPECTED * (1 - EXPECTED) / max(1, count))
    met = abs(together - EXPECTED) <= tolerance and all(s <= -0.9 for s in slopes)
    widths = [
        1.96 * e.error / e.value for run in runs for p in run if (e := p.noise) is not None and e.value > 0
    ]
    print(
        f"within {WITHIN}: {shares}, together {together:.2f} of {count}; "
        f"slopes of the noise's variance {slopes}"
    )
    print(f"half-widths of the noise: {sum(w <= 0.1 for w in widths)} of {len(widths)} within 10 %")
    report = {
        "figures": {
            "within": shares,
            "together": together,
            "cases": count,
            "noise_variance_slopes": slopes,
            "noise_half_widths_within_a_tenth": sum(w <= 0.1 for w in widths) / max(1, len(widths)),
        },
        "bars": {"together": [EXPECTED - tolerance, EXPECTED + tolerance], "slope_at_most": -0.9},
        "met": met,
    }
    print(json.dumps(report))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
