"""Speed of ``--effects auto`` against ``--effects all``, planning included, and whether their values agree.

    python benchmarks/effects.py [MATERIAL ...] [--only] [--queries N] [--spp N] [--rounds N]

For made surfaces (flat Lambert, black, dark, mid-grey), the project's assets and every material given it
prints the time of both, their ratio, what auto leaves out with the cost that the plan
states, and the cost measured: the RMS change of M, free of noise, relative to its mean. The last line is
a JSON object.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from mbtf_gen.config import GeneratorConfig
from mbtf_gen.effects import EffectsPlan
from mbtf_gen.estimates import Estimates, Stream
from mbtf_gen.generation import Job
from mbtf_gen.material import Material, load_material
from mbtf_gen.pilot import relative_change
from mbtf_gen.planning import plan_effects

ASSETS = Path(__file__).parents[1] / "assets"
# Ratio of the times, auto over all, that the surfaces are held to: at least 20 times faster, or never slower
# beyond 3 %.
BARS = {"flat Lambert": 0.05, "black": 0.05, "dark (albedo 0.05)": 1.0, "mid-grey": 1.03}


def surfaces() -> dict[str, Material]:
    """Lambert surfaces on the relief of the turtle shell."""
    relief = load_material(ASSETS / "turtle_shell")

    def lambert(albedo: float, scale: float = relief.height_scale) -> Material:
        return Material(
            height=relief.height, height_scale=scale, height_bits=None, basecolor=np.full(3, albedo)
        )

    return {
        "flat Lambert": lambert(0.5, 0.0),
        "black": lambert(0.0),
        "dark (albedo 0.05)": lambert(0.05),
        "mid-grey": lambert(0.5),
    }


def run(
    material: Material, mode: str, queries: int, spp: int, seed: int
) -> tuple[float, EffectsPlan, Estimates]:
    """Seconds of planning and tracing, the plan, and the values."""
    config = GeneratorConfig.model_validate({"material": "benchmark", "effects": {"mode": mode}})
    job = Job.of(config, material)
    asked = job.plan().draw("train", 0, queries)
    start = time.perf_counter()
    plan = plan_effects(job)
    found: Estimates = job.estimator(plan).estimate(asked, spp, Stream(seed, "train", 0))
    return time.perf_counter() - start, plan, found


def compare(name: str, material: Material, queries: int, spp: int, rounds: int) -> dict[str, Any]:
    """Both modes in turn; the first round of each compiles kernels and is not counted."""
    seconds: dict[str, list[float]] = {"auto": [], "all": []}
    values: dict[str, Estimates] = {}
    plans: dict[str, EffectsPlan] = {}
    for turn in range(rounds + 1):
        for mode in ("auto", "all") if turn % 2 else ("all", "auto"):
            took, plans[mode], values[mode] = run(material, mode, queries, spp, seed=turn % 2)
            if turn:
                seconds[mode].append(took)
    full, auto = values["all"], values["auto"]
    change, cautious = relative_change(full, auto)
    shift = (0.5 * (full.value_a + full.value_b) - 0.5 * (auto.value_a + auto.value_b)).mean(axis=1)
    mean = float(full.value_a.mean())
    z = float(shift.mean() / (shift.std() / np.sqrt(len(shift)))) if shift.any() else 0.0
    ratios = [a / b for a, b in zip(seconds["auto"], seconds["all"], strict=True)]
    plan = plans["auto"]
    row: dict[str, Any] = {
        "name": name,
        "seconds_auto": median(seconds["auto"]),
        "seconds_all": median(seconds["all"]),
        "ratio": median(ratios),
        "ratio_range": [min(ratios), max(ratios)],
        "off": [e.name for e in plan.effects if e.present and not e.on],
        "max_depth": plan.max_depth,
        "closed_form": plan.closed_form,
        "planned_cost": plan.cost,
        "measured_cost": change,
        "measured_cost_at_most": cautious,
        "mean_shift": float(shift.mean() / mean) if mean > 0 else 0.0,
        "z": z,
        "bar": BARS.get(name),
    }
    cap = f", at most {plan.max_depth} interactions" if plan.max_depth else ""
    print(
        f"{name:<20} {row['seconds_auto']:8.2f} s {row['seconds_all']:8.2f} s  x{1 / row['ratio']:<7.3g}"
        f" cost {plan.cost:.1e}, measured {change:.1e} (<= {cautious:.1e}),"
        f" mean {row['mean_shift']:+.1e} (z {z:+.1f});"
        f" off: {', '.join(row['off']) or 'nothing'}{cap}",
        flush=True,
    )
    return row


def main() -> int:
    """Print the table; 1 where a bar is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("materials", nargs="*", type=Path, help="besides the project's assets")
    parser.add_argument("--only", action="store_true", help="the given materials without the assets")
    parser.add_argument("--queries", type=int, default=1 << 20)
    parser.add_argument("--spp", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    assets = sorted(p.parent for p in ASSETS.glob("*/height.exr"))
    folders = [*assets, *options.materials] if not options.only else options.materials
    cases = surfaces() | {folder.name: load_material(folder) for folder in folders}
    print(f"{'':<20} {'auto':>10} {'all':>10}  speed-up ({options.queries} queries, {options.spp} paths)")
    rows = [compare(n, m, options.queries, options.spp, options.rounds) for n, m in cases.items()]
    met = all(row["bar"] is None or row["ratio"] <= row["bar"] for row in rows)
    print(
        json.dumps({"figures": rows, "bars": {f"{n}: auto over all": b for n, b in BARS.items()}, "met": met})
    )
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
