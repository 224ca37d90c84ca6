"""What mbtf-fit says of longer training, followed.

    python benchmarks/advice.py --out FOLDER [MATERIAL ...] [--seeds 2]

Each of six materials, in the preset ``draft`` at 64 texels, is fitted with 100, 200, … 6400 steps. After each
fit, the sentence is compared with the fit of twice the steps, on test queries of 256 paths:

- ``few``: "N steps are few: train longer";
- ``time``: "halving the error takes about T more of training, or longer", which predicts a factor;
- ``flat``: "longer training alone would hardly reduce the error";
- ``none``: nothing is said, as the history resolves nothing.

A prediction is right where the error falls by the factor that was said, within 1.5, two standard errors
included; ``few`` where it falls by a tenth or more; ``flat`` where it falls by a fifth at most. What would
be said below the fewest steps is compared as well, which tells how many steps the sentences need. FOLDER
keeps data and figures, so the same command resumes. Steps count, not seconds: other work may use the
processors.

The last line is one JSON object. Threshold: on each material but one, 0.8 of the sentences are right.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from common import ASSETS, finish, is_available, kept, parser_of, start
from front import TEST_SPP
from quality import generator_config

from mbtf_fit import FitConfig, fit
from mbtf_fit.config import DEFAULT_MODEL, FIBER_MODEL
from mbtf_fit.training import validation
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation.run import generate

MATERIALS = (
    *("turtle_shell", "twisted_wool", "cliff_rock", "basket_weave", "gold"),
    *("metal_plate", "tree_bark", "stone_bricks"),
)
CLOTHS = ("basket_weave",)
# A glossy metal, made of the heights of an asset.
GOLD = "height: {height}\nbase_color: [1.0, 0.77, 0.34]\nmetallic: 1\nroughness: 0.25\n"
STEPS = tuple(100 * 2**k for k in range(7))
RESOLUTION = 64
WITHIN, FALLS, FLAT, STANDARD_ERRORS = 1.5, 0.9, 0.8, 2.0
SHARE = 0.8


@dataclass(frozen=True)
class Judgment:
    """A sentence, and whether twice the steps had the error that it says."""

    kind: str
    factor: float
    right: bool


def data_config(name: str, folder: Path) -> GeneratorConfig:
    """Configuration of the generator; writes the file of the metal."""
    if name == "gold":
        material = folder / f"{name}.yaml"
        material.parent.mkdir(parents=True, exist_ok=True)
        material.write_text(GOLD.format(height=ASSETS / "turtle_shell" / "height.exr"))
        config = generator_config("turtle_shell", "draft", RESOLUTION)
        geometry = config.geometry.model_copy(update={"height_scale": 0.02})
        config = config.model_copy(update={"material": str(material), "geometry": geometry})
    else:
        config = generator_config(name, "draft", RESOLUTION)
    queries = config.queries.model_copy(update={"test_spp": TEST_SPP})
    return config.model_copy(update={"queries": queries})


def fitted(name: str, folder: Path, steps: int, seed: int) -> dict[str, Any]:
    """Error and history of one fit; kept in the folder."""

    def measure() -> dict[str, Any]:
        data = folder / name / "shards"
        config = data_config(name, folder)
        generate(config, data)
        model = FIBER_MODEL if name in CLOTHS else DEFAULT_MODEL
        options = {"model": model, "seed": seed, "training": {"steps": steps}}
        result = fit(FitConfig.model_validate(options), data, folder / name / "fit", overwrite=True)
        noise = result.material.description["training"].get("noise_variance")
        error = result.errors["test"]["unexplained"]
        return {**error, "history": result.history, "errors": result.errors, "noise": noise}

    return kept(folder / name / f"{steps}-{seed}.json", measure)


def judged(before: dict[str, Any], after: dict[str, Any], fewest: int) -> Judgment:
    """The sentence after a fit, against the fit of twice the steps."""
    factor = after["value"] / before["value"]
    spread = STANDARD_ERRORS * math.hypot(after["error"] / after["value"], before["error"] / before["value"])
    last = before["history"][-1]
    if last["step"] < fewest:
        return Judgment("few", factor, factor * (1.0 - spread) <= FALLS)
    halving = validation._halving(before["history"])
    if halving is None:
        return Judgment("none", factor, True)
    if halving == math.inf:
        return Judgment("flat", factor, factor * (1.0 + spread) >= FLAT)
    said = 0.5 ** (1.0 / math.log2(1.0 + halving / last["seconds"]))
    return Judgment(
        "time", factor, said / WITHIN * (1.0 - spread) <= factor <= said * WITHIN * (1.0 + spread)
    )


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("materials", nargs="*")
    parser.add_argument("--out", type=Path, required=True, help="folder of data and figures")
    parser.add_argument("--seeds", type=int, default=2)
    arguments = parser.parse_args()
    names = [n for n in arguments.materials or MATERIALS if is_available(n)]
    shares: dict[str, float] = {}
    always: dict[int, list[Judgment]] = {steps: [] for steps in STEPS[:-1]}
    for name in names:
        found: list[Judgment] = []
        for seed in range(arguments.seeds):
            fits = [fitted(name, arguments.out, steps, seed) for steps in STEPS]
            for steps, (before, after) in zip(STEPS, pairwise(fits), strict=False):
                said = judged(before, after, validation._FEWEST_STEPS)
                found.append(said)
                always[steps].append(judged(before, after, 0))
                print(
                    f"{name:16s} seed {seed} {steps:5d} steps  {before['value']:.3f} ± {before['error']:.3f}"
                    f"  {said.kind:4s}  twice the steps: x {said.factor:.2f}"
                    f"  {'right' if said.right else 'WRONG'}",
                    flush=True,
                )
        spoken = [s for s in found if s.kind != "none"]
        shares[name] = sum(s.right for s in spoken) / max(1, len(spoken))
    print(
        "\nsteps   would be said without a limit, and the share that is right; mean factor of twice the steps"
    )
    for steps, all_ in always.items():
        spoken = [s for s in all_ if s.kind != "none"]
        kinds = {kind: sum(s.kind == kind for s in all_) for kind in ("time", "flat", "none")}
        right = sum(s.right for s in spoken) / max(1, len(spoken))
        mean = math.exp(sum(math.log(max(s.factor, 1e-3)) for s in all_) / max(1, len(all_)))
        print(f"{steps:5d}   {kinds}  {right:.2f}  x {mean:.2f}")
    met = sum(share >= SHARE for share in shares.values()) >= len(shares) - 1
    return finish({"right": shares}, {"right": SHARE}, met)


if __name__ == "__main__":
    start(main)
