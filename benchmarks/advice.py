"""What mbtf-fit expects of longer training and of more queries, followed.

    python benchmarks/advice.py --out FOLDER [MATERIAL ...] [--seeds 2]

Eight materials, 64 texels across with 400 queries of 4 paths per texel, are fitted with 50, 100, 200, ...
1600 steps; with other seeds than 0, up to 800. Glossy bricks of little relief have half of the queries: fits
overfit. What a fit expects is followed, on test queries of 256 paths, three quarters of them drawn by the
highlights:

- ``few`` and ``more``, about 0.8 of this error after twice the time: right if twice the steps leave this
  factor, within 1.5;
- ``flat``, hardly any reduction: right if twice the steps leave 0.8 or more;
- ``few`` and ``none`` without a factor, where the error is too uncertain: the former is right if it falls;
- ``data``, about 0.7 of it with twice the queries: as ``more``, at equal steps, after 800 steps; the only
  sentence of a fit that has returned to an earlier state.

Two standard errors of both errors are allowed. Below, the factors of twice the steps are compared with
those that would be said, by number of steps; this is what the constants of
``mbtf_fit.training.validation`` follow from. FOLDER keeps data and figures, so the same command resumes.
Steps count, not seconds: other work may use the processors.

The last line is one JSON object. Thresholds: on each material but one, 0.8 of the sentences are right; from
200 steps on, the root mean square of log(factor that came / factor that was said) is at most 0.1.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

from common import ASSETS, finish, is_available, kept, parser_of, start
from front import QUERIES
from quality import generator_config

from mbtf_fit import FitConfig, fit
from mbtf_fit.training import validation
from mbtf_fit.training.validation import MarginalCost, marginal_cost_of
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation.run import generate

MATERIALS = (
    *("turtle_shell", "twisted_wool", "cliff_rock", "gold"),
    *("metal_plate", "tree_bark", "stone_bricks", "few"),
)
# A glossy metal, made of the heights of an asset.
GOLD = "height: {height}\nbase_color: [1.0, 0.77, 0.34]\nmetallic: 1\nroughness: 0.25\n"
STEPS = tuple(50 * 2**k for k in range(6))
# After so many steps, the number of queries is doubled; so many steps have seeds other than 0.
QUERIES_AT, OTHERS_TO = 800, 800
PER_TEXEL = 400
# Stone bricks of this relief, with half of the queries.
FEW, FEW_RELIEF, FEW_QUERIES = "few", 0.01, 200
RESOLUTION = 64
WITHIN, FLAT, STANDARD_ERRORS = 1.5, 0.8, 2.0
SHARE, DEVIATION, DEVIATION_FROM = 0.8, 0.1, 200


Sentence = Literal["few", "more", "flat", "none", "data"]


@dataclass(frozen=True)
class Followed:
    """A sentence after a fit, the factor of the error that it says, the factor that came, and whether the
    sentence was right."""

    kind: Sentence
    said: float | None
    factor: float
    right: bool


def data_config(name: str, folder: Path, twice: bool) -> GeneratorConfig:
    """Configuration of the generator; writes the file of the metal."""
    if name == "gold":
        material = folder / f"{name}.yaml"
        material.parent.mkdir(parents=True, exist_ok=True)
        material.write_text(GOLD.format(height=ASSETS / "turtle_shell" / "height.exr"))
        config = generator_config("turtle_shell", "draft", RESOLUTION)
        geometry = config.geometry.model_copy(update={"height_scale": 0.02})
        config = config.model_copy(update={"material": str(material), "geometry": geometry})
    else:
        config = generator_config("stone_bricks" if name == FEW else name, "draft", RESOLUTION)
    if name == FEW:
        geometry = config.geometry.model_copy(update={"height_scale": FEW_RELIEF})
        config = config.model_copy(update={"geometry": geometry})
    train = (FEW_QUERIES if name == FEW else PER_TEXEL) * (2 if twice else 1)
    own = {**QUERIES, "train": f"{train}/texel"}
    queries = config.queries.model_copy(update=own)
    return config.model_copy(update={"queries": queries})


def fitted(name: str, folder: Path, steps: int, seed: int, twice: bool = False) -> dict[str, Any]:
    """Errors and history of one fit, of `twice` the queries or not; kept in the folder."""
    home = folder / f"{name}-twice" if twice else folder / name

    def measure() -> dict[str, Any]:
        generate(data_config(name, folder, twice), home / "shards")
        options = FitConfig.model_validate({"seed": seed, "training": {"steps": steps}})
        result = fit(options, home / "shards", home / "fit", overwrite=True)
        cost = result.marginal_cost
        share = None if cost is None else cost.noise_share
        error = result.errors["test"]["unexplained"]
        recorded = result.material.description["training"]
        data = {key: recorded[key] for key in ("noise_ratio", "queries_per_texel")}
        found = {"history": result.history, "noise_share": share, "kept": result.kept_step, "data": data}
        return error | found

    return kept(home / f"{steps}-{seed}.json", measure)


def followed(before: dict[str, Any], after: dict[str, Any], kind: Sentence, said: float | None) -> Followed:
    """A sentence that says a factor, against the error that came."""
    factor = after["value"] / before["value"]
    spread = STANDARD_ERRORS * math.hypot(after["error"] / after["value"], before["error"] / before["value"])
    low, high = factor * (1.0 - spread), factor * (1.0 + spread)
    if kind == "flat":
        right = high >= FLAT
    elif said is None:
        right = kind == "none" or low < 1.0
    else:
        right = low <= said * WITHIN and high >= said / WITHIN
    return Followed(kind, said, factor, right)


def sentence(cost: MarginalCost) -> Sentence:
    """What a fit says of longer training."""
    if cost.few:
        return "few"
    if cost.doubling is None:
        return "none"
    return "flat" if cost.doubling >= validation.FLAT else "more"


def shown(name: str, seed: int, steps: int, before: dict[str, Any], found: Followed) -> None:
    """Print one row."""
    change = "queries" if found.kind == "data" else "steps"
    said = "      " if found.said is None else f"x {found.said:.2f}"
    print(
        f"{name:12s} seed {seed} {steps:5d} steps  {before['value']:.4f} ± {before['error']:.4f}  "
        f"{found.kind:4s} {said}  twice the {change}: x {found.factor:.2f}  "
        f"{'right' if found.right else 'WRONG'}",
        flush=True,
    )


def root_mean_square(x: list[float]) -> float:
    """Of some numbers; 0 of none."""
    return math.sqrt(sum(each * each for each in x) / max(1, len(x)))


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("materials", nargs="*")
    parser.add_argument("--out", type=Path, required=True, help="folder of data and figures")
    parser.add_argument("--seeds", type=int, default=2)
    arguments = parser.parse_args()
    names = [n for n in arguments.materials or MATERIALS if n in ("gold", FEW) or is_available(n)]
    shares: dict[str, float] = {}
    by_steps: dict[int, list[Followed]] = {steps: [] for steps in STEPS[:-1]}
    for name in names:
        found: list[Followed] = []
        for seed in range(arguments.seeds):
            used = [steps for steps in STEPS if seed == 0 or steps <= OTHERS_TO]
            fits = {steps: fitted(name, arguments.out, steps, seed) for steps in used}
            for steps, longer in pairwise(used):
                if fits[steps]["kept"] is not None:
                    continue
                cost = marginal_cost_of(fits[steps]["history"], {}, fits[steps]["data"])
                assert cost is not None
                found.append(followed(fits[steps], fits[longer], sentence(cost), cost.doubling))
                by_steps[steps].append(found[-1])
                shown(name, seed, steps, fits[steps], found[-1])
        # One seed: the scatter of a fit is small beside the effect.
        before = fitted(name, arguments.out, QUERIES_AT, 0)
        if (share := before["noise_share"]) is not None:
            after = fitted(name, arguments.out, QUERIES_AT, 0, twice=True)
            found.append(followed(before, after, "data", 1.0 - 0.5 * share))
            shown(name, 0, QUERIES_AT, before, found[-1])
        spoken = [s for s in found if s.kind != "none"]
        shares[name] = sum(s.right for s in spoken) / max(1, len(spoken))
    print("\nsteps  sentences; right; twice the steps (mean); root mean square of log(came / said)")
    deviations: list[float] = []
    for steps, all_ in by_steps.items():
        if not all_:
            continue
        kinds = dict(Counter(s.kind for s in all_))
        spoken = [s for s in all_ if s.kind != "none"]
        right = sum(s.right for s in spoken) / max(1, len(spoken))
        mean = math.exp(sum(math.log(s.factor) for s in all_) / len(all_))
        logs = [math.log(s.factor / s.said) for s in all_ if s.said is not None]
        print(f"{steps:5d}  {kinds}  {right:.2f}  x {mean:.2f}  {root_mean_square(logs):.2f}")
        deviations += logs if steps >= DEVIATION_FROM else []
    met = sum(share >= SHARE for share in shares.values()) >= len(shares) - 1
    met = met and root_mean_square(deviations) <= DEVIATION
    figures = {"right": shares, "deviation": root_mean_square(deviations)}
    return finish(figures, {"right": SHARE, "deviation": DEVIATION}, met)


if __name__ == "__main__":
    start(main)
