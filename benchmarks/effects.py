"""What the effects plan saves, and whether its bias bounds hold.

    python benchmarks/effects.py [MATERIAL ...] [--only] [--queries N] [--spp N] [--rounds N]
    python benchmarks/effects.py [MATERIAL ...] [--only] --bias

Without ``--bias``: time of ``--effects auto``, planning included, and of ``--effects all``, what the plan
leaves out, its bias bound, and the measured RMS change of M relative to its mean, free of noise. Materials
are surfaces made here, the assets, and every material given.

``--bias`` measures the bias of leaving out each effect that is off or capped, with many paths at queries of
their own. No bias bound may lie below it by more than two standard errors. Both sides use the same random
numbers, so a path that the setting does not change cancels exactly. Where the plan says that nothing changes,
noise alone is measured: more paths of fewer queries make it small.

The last line is one JSON object.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from common import ASSETS, finish, parser_of, start

from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.planning.bounds import Change
from mbtf_gen.planning.effects_plan import EffectsPlan
from mbtf_gen.planning.job import Job
from mbtf_gen.planning.run_plan import PILOT_ROULETTE, SMALL_RUN, plan_effects
from mbtf_gen.planning.simulation import build_estimator
from mbtf_gen.render.estimates import Estimates, Stream
from mbtf_gen.tile.loading import load_material
from mbtf_gen.tile.protocol import Tile

# Ratio of the times, auto over all, that the surfaces are held to: at least 20 times faster, or never slower
# beyond 3%.
THRESHOLDS = {"flat Lambert": 0.05, "black": 0.05, "dark (albedo 0.05)": 1.0, "mid-gray": 1.03}


def surfaces() -> dict[str, Tile]:
    """Lambert surfaces on the relief of the turtle shell."""
    relief = load_material(ASSETS / "turtle_shell")
    removed = dict.fromkeys(relief.maps)

    def lambert(albedo: float, scale: float | None = None) -> Tile:
        return relief.at(scale).with_maps(**removed | {"base_color": np.full(3, albedo)})

    return {
        "flat Lambert": lambert(0.5, 0.0),
        "black": lambert(0.0),
        "dark (albedo 0.05)": lambert(0.05),
        "mid-gray": lambert(0.5),
    }


def run(material: Tile, mode: str, queries: int, spp: int, seed: int) -> tuple[float, EffectsPlan, Estimates]:
    """Seconds of planning and tracing, the plan, and the values."""
    config = GeneratorConfig.model_validate({"material": "benchmark", "effects": {"mode": mode}})
    job = Job.of(config, material)
    chosen = job.query_plan.draw("train", 0, queries)
    start = time.perf_counter()
    # Pilots where a run of this size takes them.
    plan = plan_effects(job, pilots=queries * spp >= SMALL_RUN)
    found: Estimates = build_estimator(job, plan).estimate(chosen, spp, Stream(seed, "train", 0))
    return time.perf_counter() - start, plan, found


def compare(name: str, material: Tile, queries: int, spp: int, rounds: int) -> dict[str, Any]:
    """Both modes in turn; the first round of each compiles kernels and is not counted."""
    seconds: dict[str, list[float]] = {"auto": [], "all": []}
    values: dict[str, Estimates] = {}
    plans: dict[str, EffectsPlan] = {}
    for turn in range(rounds + 1):
        for mode in ("auto", "all") if turn % 2 else ("all", "auto"):
            took, plans[mode], values[mode] = run(material, mode, queries, spp, seed=turn % 2)
            if turn:
                seconds[mode].append(took)
    change = Change.of(values["all"], values["auto"])
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
        "bias_bound": plan.bias_bound,
        "measured_bias": change.rms,
        "measured_at_most": change.upper,
        "threshold": THRESHOLDS.get(name),
    }
    cap = f", at most {plan.max_depth} interactions" if plan.max_depth else ""
    print(
        f"{name:<20} {row['seconds_auto']:8.2f} s {row['seconds_all']:8.2f} s  x{1 / row['ratio']:<7.3g}"
        f" bias bound {plan.bias_bound:.1e}, measured {change.rms:.1e} (<= {change.upper:.1e});"
        f" off: {', '.join(row['off']) or 'nothing'}{cap}",
        flush=True,
    )
    return row


def truth(full: Estimates, cut: Estimates) -> tuple[float, float, float]:
    """RMS change relative to the mean, less and plus two standard errors of the mean square: (measured, at
    least, at most)."""
    a, b = ((x - y).astype(np.float64) for x, y in ((full.value_a, cut.value_a), (full.value_b, cut.value_b)))
    square = np.mean(a * b, axis=1)
    mean = 0.5 * float(np.mean(full.value_a + full.value_b))
    spread = 2.0 * float(square.std()) / np.sqrt(len(square))
    found, low, high = (np.sqrt(max(square.mean() + d, 0.0)) / mean for d in (0.0, -spread, spread))
    return float(found), float(low), float(high)


def verdict(stated: float, low: float, high: float) -> str:
    """Of a bound, against what was measured."""
    if low > stated:
        return "wrong"
    if stated == 0.0:
        return "no change seen"
    return "holds" if high <= stated else "not refuted"


def biases_of(name: str, material: Tile, queries: int, spp: int) -> list[dict[str, Any]]:
    """Stated and measured biases of one material, printed as they come."""
    job = Job.of(GeneratorConfig.model_validate({"material": "benchmark"}), material)
    plan = plan_effects(job)

    def values(plan: EffectsPlan, limit: int | None = None, fewer: int = 1) -> Estimates:
        chosen = job.query_plan.draw("test", 0, queries // fewer).flat()
        found: Estimates = build_estimator(job, plan).estimate(
            chosen, spp * fewer**2, Stream(7, "test", 0), limit=limit, roulette=PILOT_ROULETTE
        )
        return found

    rows = []

    def row(effect: str, state: str, stated: float, found: tuple[float, float, float]) -> None:
        measured, low, high = found
        rows.append(
            {
                "material": name,
                "effect": effect,
                "state": state,
                "stated": stated,
                "measured": measured,
                "at_least": low,
                "at_most": high,
                "verdict": verdict(stated, low, high),
            }
        )
        seen = f"{measured:.3g} ({low:.3g} ... {high:.3g})"
        print(
            f"{name:<16} {effect:<16} {state:<8} < {stated:<16.2g} {seen:<36} {rows[-1]['verdict']}",
            flush=True,
        )

    if plan.cap_bias_bound:
        unlimited = replace(plan, max_depth=0)
        row(
            "interreflection",
            f"cap {plan.max_depth}",
            plan.cap_bias_bound,
            truth(values(unlimited), values(unlimited, plan.max_depth)),
        )
    for effect in plan.effects:
        if not effect.on and effect.present and (plan.on("parallax") or effect.name == "parallax"):
            whole = replace(
                plan, effects=tuple(replace(e, on=True) if e.name == effect.name else e for e in plan.effects)
            )
            fewer = 8 if effect.reason == "exact" else 1
            pair = values(whole, fewer=fewer), values(plan, fewer=fewer)
            row(effect.name, "off", effect.bias_bound or 0.0, truth(*pair))
    return rows


def biases(cases: dict[str, Tile], queries: int, spp: int) -> int:
    """Compare bounds with measured biases; 1 where a bound is wrong."""
    print(f"{'material':<16} {'effect':<16} {'':<8} {'plan states':<18} measured (two standard errors)")
    rows = [row for name, material in cases.items() for row in biases_of(name, material, queries, spp)]
    met = all(row["verdict"] != "wrong" for row in rows)
    return finish(rows, {"wrong bounds": 0}, met)


def main() -> int:
    """Print the table; 1 where a bar is missed."""
    parser = parser_of(__doc__)
    parser.add_argument("materials", nargs="*", type=Path, help="besides the project's assets")
    parser.add_argument("--only", action="store_true", help="the given materials without the assets")
    parser.add_argument("--queries", type=int, help="default: 2^20, or 2^14 with --bias")
    parser.add_argument("--spp", type=int, help="default: 4, or 64 with --bias")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--bias", action="store_true", help="measure the bias of what is left out")
    options = parser.parse_args()
    assets = sorted(p.parent for p in ASSETS.glob("*/height.exr"))
    folders = [*assets, *options.materials] if not options.only else options.materials
    loaded = {folder.name: load_material(folder) for folder in folders}
    if options.bias:
        return biases(loaded, options.queries or 1 << 14, options.spp or 64)
    queries, spp = options.queries or 1 << 20, options.spp or 4
    print(f"{'':<20} {'auto':>10} {'all':>10}  speed-up ({queries} queries, {spp} paths)")
    rows = [compare(n, m, queries, spp, options.rounds) for n, m in (surfaces() | loaded).items()]
    met = all(row["threshold"] is None or row["ratio"] <= row["threshold"] for row in rows)
    return finish(rows, {f"{n}: auto over all": limit for n, limit in THRESHOLDS.items()}, met)


if __name__ == "__main__":
    start(main)
