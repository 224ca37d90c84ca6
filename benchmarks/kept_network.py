"""New materials that keep the network of others: their error beside that of a network of their own.

    python benchmarks/kept_network.py --out FOLDER [--shared 1min] [--time 8s] [--only NAME ...]

Each of the five assets with a height map is in turn a material that the network has not seen. One network is
trained on the other four and on three variants of each: turned by 90°, by 180°, and by 270° with half the
height. Then the new material is fitted twice for ``--time``: with that network kept, and with a network of
its own of the default options. Its figures are the two errors, their ratio, and the seconds of the whole
command with the kept network.

Data and networks of an earlier call are kept. Times mean little on a busy machine. The last line is a JSON
object.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from library import ASSETS, RELIEFS, command
from PIL import Image

from mbtf_core.atomic import write_text
from mbtf_core.config.yaml_file import dump_yaml, read_yaml

# Quarter turns and factors of heights, by the suffix of a variant's name.
VARIANTS = {"": (0, 1.0), "_90": (1, 1.0), "_180": (2, 1.0), "_270_low": (3, 0.5)}
DATA = ("--resolution", "64", "--queries", "200/texel", "--test-queries", "8192")
DATA_SETTINGS = ("light.width=5", "queries.min_cos=0.2", "queries.test_spp=128")
THRESHOLDS = {"seconds with the kept network": 15.0, "ratio": 1.3}


def turned(name: str, suffix: str, folder: Path) -> Path:
    """A material with the maps of an asset turned counterclockwise."""
    turns, scale = VARIANTS[suffix]
    source, out = ASSETS / name, folder / f"{name}{suffix}"
    if (out / "material.yaml").is_file():
        return out
    out.mkdir(parents=True, exist_ok=True)
    with OpenEXR.File(str(source / "height.exr")) as file:
        heights = next(iter(file.channels().values())).pixels
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Y": np.rot90(heights, turns).copy()}) as file:
        file.write(str(out / "height.exr"))
    for role in ("base_color", "roughness"):
        with Image.open(source / f"{role}.png") as image:
            Image.fromarray(np.rot90(np.asarray(image), turns).copy()).save(out / f"{role}.png")
    described = read_yaml(source / "material.yaml") if (source / "material.yaml").is_file() else {}
    maps: dict[str, Any] = {"base_color": "base_color.png", "roughness": "roughness.png"}
    maps["height"] = {"file": "height.exr", "scale": scale}
    if "specular" in described:
        maps["specular"] = float(described["specular"])
    write_text(out / "material.yaml", dump_yaml(maps))
    return out


def settings(assignments: list[str] | tuple[str, ...]) -> list[str]:
    """Command-line words of assignments."""
    return [word for text in assignments for word in ("--set", text)]


def unexplained(report: dict[str, Any]) -> tuple[float, float]:
    """Error of a fit's test split and its standard error."""
    found = report["errors"]["test"]["unexplained"]
    return float(found["value"]), float(found["error"])


def fold(name: str, data: dict[str, Path], options: argparse.Namespace) -> dict[str, Any]:
    """Errors of one material with the network of the others and with its own."""
    fits = options.out / "fits" / options.model / name
    others = [folder for variant, folder in data.items() if not variant.startswith(name)]
    joint = [*others, "--shared-decoder", "--model", options.model, "--time", options.shared]
    command("mbtf-fit", "--many", *joint, *settings(options.set), "-o", fits / "others")
    # Files that a fit has just written are still on their way to the disk.
    os.sync()
    found = []
    for kind in (["--decoder", fits / "others" / "decoder"], ["--model", options.model]):
        out = fits / kind[0].strip("-")
        words = [data[name], *kind, "--time", options.time, "-o", out, "--overwrite"]
        report, seconds = command("mbtf-fit", *words)
        found.append((*unexplained(report), seconds))
    (a, a_bar, seconds), (b, b_bar, _) = found
    # Both errors are of the same test queries, so this bar of the ratio is an upper bound.
    bar = a / b * math.hypot(a_bar / a, b_bar / b)
    print(
        f"{name:18} {len(others):3} others: kept {a:.4f} ± {a_bar:.4f}, own {b:.4f} ± {b_bar:.4f}, "
        f"ratio {a / b:.2f} ± {bar:.2f}, {seconds:.1f} s",
        flush=True,
    )
    return {"kept": [a, a_bar], "own": [b, b_bar], "ratio": [a / b, bar], "seconds": round(seconds, 2)}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder to work in")
    parser.add_argument("--model", default="relief", choices=("relief", "neumip"))
    parser.add_argument("--shared", default="1min", help="training time of the network of the others")
    parser.add_argument("--time", default="8s", help="training time of the new material")
    parser.add_argument("--only", nargs="*", choices=RELIEFS, help="new materials; all by default")
    size = ["network.width=64", "network.channels=16"]
    described = f"option of the network; by default {' and '.join(size)}"
    parser.add_argument("--set", action="append", metavar="KEY=VALUE", help=described)
    options = parser.parse_args()
    options.set = options.set or size
    data = {}
    for name, suffix in itertools.product(RELIEFS, VARIANTS):
        material = turned(name, suffix, options.out / "materials")
        out = data[material.name] = options.out / "data" / material.name
        command("mbtf-gen", material, *DATA, *settings(DATA_SETTINGS), "-o", out)
    folds = {name: fold(name, data, options) for name in options.only or RELIEFS}
    # A few values can decide the error of a glossy material, so each fold counts by its error bar.
    logs = np.array([[math.log(r), bar / r] for r, bar in (one["ratio"] for one in folds.values())])
    weights = logs[:, 1] ** -2
    mean = math.exp(float(np.average(logs[:, 0], weights=weights)))
    bar = mean / math.sqrt(weights.sum())
    slowest = max(one["seconds"] for one in folds.values())
    print(
        f"weighted geometric mean of the ratios {mean:.2f} ± {bar:.2f}; the slowest command {slowest:.1f} s"
    )
    figures = {"folds": folds, "mean ratio": [round(mean, 4), round(bar, 4)], "slowest, s": slowest}
    print(json.dumps({**figures, "thresholds": THRESHOLDS}))
    met = mean <= THRESHOLDS["ratio"] and slowest <= THRESHOLDS["seconds with the kept network"]
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
