"""Error of `relief` on surfaces under a clear coat that it knows, over the error where the coat is unknown.

    python benchmarks/clear_coat.py --out FOLDER [MATERIAL ...] [--steps 400] [--seeds 3]

Matte leather, with three times the height scale that its normal map suggests, and a metal plate get a clear
coat of weight 1 and roughness 0.1. Both ways are trained for the same steps on the same data: 200 queries per
texel of 16 paths at 64 texels across. Few of the 131 072 test queries are highlights, which decide on the
error; both ways are tested with the same ones. Errors are means over seeds ± their standard errors. FOLDER
keeps data and figures, so the same command resumes. The last line is one JSON object.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from common import TEXTURE_SETS, finish, is_available, kept, parser_of, start

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.geometry import Geometry
from mbtf_fit import FitConfig, fit
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation.run import generate

# Files and numbers of each material, and its height scale.
MATERIALS: dict[str, tuple[dict[str, Any], float]] = {
    "leather_fine": ({"height": "height.jpg", "base_color": "basecolor.jpg"}, 0.003),
    "metal_plate": (
        {"height": "height.png", "roughness": "roughness.png", "metallic": "metallic.jpg"},
        0.00873,
    ),
}
COAT = {"normal": "normal.jpg", "clearcoat": 1.0, "clearcoat_roughness": 0.1}
QUERIES = {"resolution": 64, "train": "200/texel", "spp": 16, "test": "131072", "test_spp": 64}
# Geometric means over seeds.
THRESHOLDS = {"ratio": 0.5}


def shards(name: str, folder: Path) -> Path:
    """Data of a coated material, generated where they are missing."""
    entries, height_scale = MATERIALS[name]
    folder.mkdir(parents=True, exist_ok=True)
    given = {
        key: str(TEXTURE_SETS / name / value) if isinstance(value, str) else value
        for key, value in {**entries, **COAT}.items()
    }
    (folder / "material.yaml").write_text(json.dumps(given), encoding="utf-8")
    config = GeneratorConfig.model_validate(
        {
            "material": str(folder / "material.yaml"),
            "geometry": {"height_scale": height_scale},
            "queries": QUERIES,
        }
    )
    generate(config, folder / "shards")
    return folder / "shards"


def error_of(data: Path, folder: Path, steps: int, seed: int, known: bool) -> dict[str, Any]:
    """Error of one fit; kept in a folder."""
    name = f"{'known' if known else 'unknown'}-{steps}-{seed}"
    whole: Any = Dataset.geometry

    def without_coat(dataset: Dataset) -> Geometry:
        return replace(whole(dataset), clearcoat=None, clearcoat_roughness=None)

    def measure() -> dict[str, Any]:
        config = FitConfig.model_validate({"seed": seed, "training": {"steps": steps, "batch": 1 << 14}})
        cls: Any = Dataset
        cls.geometry = whole if known else without_coat
        try:
            test = fit(config, data, folder / name, overwrite=True).errors["test"]
        finally:
            cls.geometry = whole
        return {"mse": test["mse"]["value"], "unexplained": test["unexplained"]["value"]}

    return kept(folder / f"{name}.json", measure)


def compared(name: str, folder: Path, steps: int, seeds: int) -> dict[str, Any]:
    """Errors with and without the coat, and the ratio of both."""
    data = shards(name, folder)
    fits = {k: [error_of(data, folder, steps, seed, k) for seed in range(seeds)] for k in (False, True)}
    found: dict[str, Any] = {"material": name}
    for key, known in (("unknown", False), ("known", True)):
        values = np.array([one["unexplained"] for one in fits[known]])
        found[key] = [float(values.mean()), float(values.std(ddof=1) / np.sqrt(seeds))]
    ratios = np.log([b["mse"] / a["mse"] for a, b in zip(fits[False], fits[True], strict=True)])
    ratio = float(np.exp(ratios.mean()))
    found["ratio"] = [ratio, ratio * float(ratios.std(ddof=1) / np.sqrt(seeds))]
    texts = (f"{key} {found[key][0]:.3f} ± {found[key][1]:.3f}" for key in ("unknown", "known", "ratio"))
    print(f"{name:14s} {'   '.join(texts)}", flush=True)
    return found


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("materials", nargs="*")
    parser.add_argument("--out", type=Path, required=True, help="folder of data and figures")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--seeds", type=int, default=3)
    arguments = parser.parse_args()
    names = [n for n in arguments.materials or MATERIALS if is_available(n)]
    found = [compared(n, arguments.out / n, arguments.steps, arguments.seeds) for n in names]
    met = all(one["ratio"][0] <= THRESHOLDS["ratio"] for one in found) if found else None
    return finish(found, THRESHOLDS, met)


if __name__ == "__main__":
    start(main)
