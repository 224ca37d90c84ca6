"""Which errors of a fit are visible: HDR-FLIP of pictures against PSNR and unexplained variance.

    python benchmarks/visible_errors.py [--size 128] [--spp 256] [--steps 100 400 1600] [--keep FOLDER]

Fits every material of ``assets/`` for several numbers of steps and compares pictures of eight scenes with
path-traced references. The errors of each picture are also scaled by 1/2, 1/4, ... in linear light, which
stands for better fits with the same pattern of errors. Prints, for each limit of HDR-FLIP, the PSNR and the
unexplained variance of test queries at which the mean over pictures reaches it, with their spread over fits.
The limits are HDR-FLIP of uniform grays that differ from L* = 50 by 1, 2.3 and 5 (CIELAB); 2.3 is one just
noticeable difference (Mahy et al. 1994).

The last line is one JSON object with the figures and the threshold: the limits in decibels that ``mbtf_fit``
uses lie within two decibels of the measured ones. Exit code 1 where one does not.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.atomic import read_json
from mbtf_core.console import Console
from mbtf_fit.formatting import VISIBILITY
from mbtf_pipeline.compare.image_files import read_picture
from mbtf_pipeline.compare.perceptual_metrics import flip
from mbtf_pipeline.recipe import Recipe
from mbtf_pipeline.run import run_recipe
from mbtf_pipeline.run_folder import COMPARE, machine

ASSETS = Path(__file__).parent.parent / "assets"
MATERIALS = ("twisted_wool", "straight_wool", "turtle_shell", "cliff_rock", "insulation_foam")
# Differences in L* at L* = 50, and factors of a picture's error.
LIGHTNESS = (1.0, 2.3, 5.0)
FACTORS = tuple(2.0**-i for i in range(7))
# Decibels by which the limits in use may differ from the measured ones.
MOST = 2.0


def flip_limits() -> list[float]:
    """HDR-FLIP of uniform grays that differ by :data:`LIGHTNESS`."""

    def gray(lightness: float) -> Any:
        return np.full((32, 32, 3), ((lightness + 16.0) / 116.0) ** 3, np.float32)

    return [flip(gray(50.0 + d), gray(50.0), 1.0).hdr for d in LIGHTNESS]


def recipe_of(material: str, arguments: argparse.Namespace) -> Recipe:
    directions = [{"elevation": 90, "azimuth": -90}, {"elevation": 35, "azimuth": -90}]
    return Recipe.model_validate(
        {
            "name": material.replace("_", "-"),
            "generate": {
                "material": str(ASSETS / material),
                "queries": {
                    "resolution": 64, "train": "300/texel", "test": "16384", "test_spp": 256, "min_cos": 0.3,
                },
            },
            "fit": {f"steps-{n}": {"model": "neumip", "training": {"steps": n}} for n in arguments.steps},
            "compare": {
                "views": directions,
                "lights": [{"elevation": 50, "azimuth": 45}, {"elevation": 25, "azimuth": 160}],
                "tiles_across": [1, 4],
                "size": arguments.size,
                "spp": arguments.spp,
            },
        }
    )  # fmt: skip


def rows_of(material: str, folder: Path) -> list[dict[str, Any]]:
    """A row per fit and factor of the error: means over the scenes."""
    comparison = read_json(folder / COMPARE / "comparison.json")
    white = comparison["white"]
    rows = []
    for fit, record in comparison["test"].items():
        test = record["splits"]["test"]
        visible: dict[float, list[float]] = {factor: [] for factor in FACTORS}
        for picture in comparison["pictures"]:
            files = (picture["references"]["query"]["file"], picture["fits"][fit]["file"])
            reference, fitted = (read_picture(folder / COMPARE / file) for file in files)
            for factor, found in visible.items():
                found.append(flip(reference + factor * (fitted - reference), reference, white).hdr)
        for factor, found in visible.items():
            rows.append(
                {
                    "material": material,
                    "fit": fit,
                    "factor": factor,
                    "unexplained": factor**2 * test["unexplained"]["value"],
                    "psnr": test["psnr"]["value"] - 20.0 * math.log10(factor),
                    "flip": float(np.mean(found)),
                }
            )
            print("{material:16s} {fit:11s} x{factor:<8g} unexplained {unexplained:.4f}  {psnr:5.1f} dB  "
                  "HDR-FLIP {flip:.3f}".format(**rows[-1]), flush=True)  # fmt: skip
    return rows


def crossing(rows: list[dict[str, Any]], key: str, limit: float) -> list[float]:
    """Per material and fit, the `key` at which HDR-FLIP equals the limit, interpolated."""
    out = []
    for name in sorted({(row["material"], row["fit"]) for row in rows}):
        own = sorted((r for r in rows if (r["material"], r["fit"]) == name), key=lambda r: r["flip"])
        visible = [row["flip"] for row in own]
        if visible[0] < limit < visible[-1]:
            scale = [row[key] if key == "psnr" else math.log10(row[key]) for row in own]
            out.append(float(np.interp(np.log(limit), np.log(visible), scale)))
    return out


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--size", type=int, default=128, help="pixels along each side")
    parser.add_argument("--spp", type=int, default=256, help="paths per pixel")
    parser.add_argument("--steps", type=int, nargs="+", default=[100, 400, 1600], help="of the fits")
    parser.add_argument("--keep", type=Path, help="folder of the runs; a temporary one by default")
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as temporary:
        for material in MATERIALS:
            folder = (arguments.keep or Path(temporary)) / material
            run_recipe(recipe_of(material, arguments), folder, console=Console(quiet=True))
            rows += rows_of(material, folder)
    figures = []
    for difference, limit, (used, _) in zip(LIGHTNESS, flip_limits(), VISIBILITY, strict=False):
        psnr, unexplained = (crossing(rows, key, limit) for key in ("psnr", "unexplained"))
        figures.append(
            {
                "lightness": difference,
                "flip": limit,
                "psnr": float(np.mean(psnr)),
                "psnr_deviation": float(np.std(psnr)),
                "psnr_used": used,
                "unexplained": 10.0 ** float(np.mean(unexplained)),
                "unexplained_deviation_db": 10.0 * float(np.std(unexplained)),
            }
        )
        print(figures[-1])
    met = all(abs(f["psnr"] - f["psnr_used"]) <= MOST for f in figures)
    thresholds = {"difference_db": MOST}
    print(json.dumps({"figures": figures, "thresholds": thresholds, "met": met, "machine": machine()}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
