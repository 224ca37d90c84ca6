"""Standard error of the error of a fit, with and without test queries drawn by highlights, at equal paths.

    python benchmarks/test_sets.py --out FOLDER [MATERIAL ...] [--paths 4e6] [--spp 16]

For each material, one fit is evaluated on two test sets: one with the distribution of the training queries,
and one with ``queries.test_highlights``, whose pilot counts as paths, too. The fit is ``relief``, or
``cloth`` on cloth, at 64 texels across. FOLDER keeps fits and figures, so the same command resumes.

The last line is one JSON object. Thresholds: the standard error with highlights is at most 5% of the error,
and both errors agree within four standard errors where that of the plain set is at most a quarter of its
error.
"""

from __future__ import annotations

import math
import time
from functools import partial
from pathlib import Path
from typing import Any

from common import CLOTHS, HEIGHT_SCALES, RELIEFS, finish, is_available, kept, parser_of, start
from front import CLOTH_MODELS, RELIEF
from quality import generator_config

from mbtf_core.config.settings import deep_merge
from mbtf_core.data.dataset import Dataset
from mbtf_core.stats import Estimate, unexplained_variance
from mbtf_fit import FitConfig, Material, fit
from mbtf_fit.data.loader import load_split
from mbtf_gen.generation.run import generate
from mbtf_gen.planning.highlights import PILOT_MOST, PILOT_SHARE, PILOT_SPP

RESOLUTION = 64
TRAIN = {"train": "400/texel", "spp": 4, "test": "1024"}
STANDARD_ERRORS, RESOLVED = 4.0, 0.25
THRESHOLDS = {"relative_error": 0.05, "standard_errors": STANDARD_ERRORS}


def test_set(name: str, folder: Path, share: float, paths: float, spp: int) -> dict[str, Any]:
    """Error of a material's fit on one test set of so many paths, its pilot included, `spp` per query."""
    pilot = min(PILOT_SHARE / (1.0 + PILOT_SHARE) * paths, PILOT_MOST * PILOT_SPP) if share else 0.0
    count = round((paths - pilot) / spp)
    options = {"train": "2", "test": str(count), "test_spp": spp, "test_highlights": share}
    out = folder / f"test-{share:g}-{paths:g}-{spp}"
    began = time.process_time()
    generate(generator_config(name, "draft", RESOLUTION, **options), out)
    seconds = time.process_time() - began
    test = load_split(Dataset.open(out), "test")
    predicted = Material.load(folder / "fit").predict(test)
    found = unexplained_variance(predicted, *test.halves)
    return {**found.as_dict(), "processor_seconds": round(seconds, 1)}


def trained(name: str, folder: Path, steps: int) -> None:
    """Fit a material, unless it is fitted."""
    if (folder / "fit" / "material.json").exists():
        return
    generate(generator_config(name, "draft", RESOLUTION, **TRAIN), folder / "train")
    model = CLOTH_MODELS["relief"] if name in CLOTHS else RELIEF
    settings = deep_merge(model, {"training": {"steps": steps}})
    fit(FitConfig.model_validate(settings), folder / "train", folder / "fit", overwrite=True)


def estimate_of(figures: dict[str, Any]) -> Estimate:
    """The estimate of stored figures; NaN where they are undefined."""
    value, error = (math.nan if figures[key] is None else figures[key] for key in ("value", "error"))
    return Estimate(value, error, figures["n"])


def compared(name: str, folder: Path, steps: int, share: float, paths: float, spp: int) -> dict[str, Any]:
    """Both errors of a material."""
    trained(name, folder, steps)
    found = {
        label: kept(
            folder / f"{label}-{s:g}-{paths:g}-{spp}.json", partial(test_set, name, folder, s, paths, spp)
        )
        for label, s in (("plain", 0.0), ("highlights", share))
    }
    plain, drawn = map(estimate_of, found.values())
    gap = abs(plain.value - drawn.value) / math.hypot(plain.error, drawn.error)
    resolved = plain.relative_error <= RESOLVED
    met = drawn.relative_error <= THRESHOLDS["relative_error"]
    met &= not resolved or gap <= STANDARD_ERRORS
    gain = (plain.relative_error / drawn.relative_error) ** 2
    cells = [f"`{name}`", *(f"{e}, {e.relative_error:.1%}" for e in (plain, drawn)), f"{gain:.0f}"]
    cells += [f"{one['processor_seconds']:.0f} s" for one in found.values()]
    print(f"| {' | '.join(cells)} |", flush=True)
    return {"material": name, **found, "met": met}


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("materials", nargs="*")
    parser.add_argument("--out", type=Path, required=True, help="folder of fits and figures")
    parser.add_argument("--paths", type=float, default=4e6, help="paths of each test set")
    parser.add_argument("--spp", type=int, default=16, help="paths per test query")
    parser.add_argument("--share", type=float, default=0.75, help="share drawn by highlights")
    parser.add_argument("--steps", type=int, default=1200, help="training steps")
    arguments = parser.parse_args()
    names = arguments.materials or [*RELIEFS, *HEIGHT_SCALES, *CLOTHS]
    found = [
        compared(name, arguments.out / name, arguments.steps, arguments.share, arguments.paths, arguments.spp)
        for name in names
        if is_available(name)
    ]
    return finish(found, THRESHOLDS, bool(found) and all(one["met"] for one in found))


if __name__ == "__main__":
    start(main)
