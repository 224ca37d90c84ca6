"""A library of small materials on this machine, and new materials that keep the network of others.

    python benchmarks/library.py --out FOLDER [--materials 20] [--training 5min] [--cluster local]
    python benchmarks/library.py --out FOLDER --network [--model relief] [--time 8s] [--only NAME ...]

The first call runs a library of the assets and of variants of them: half the height, a smoother surface, or
both. Its figures are the seconds of the whole command, and those of its stages.

The second call, with ``--network``, takes each asset with a height map in turn as a material that the network
has not seen: it trains one network on all the other materials, no variants of this one among them, and fits
this one twice for ``--time``, with that network kept and with a network of its own. Its figures are the two
errors, their ratio, and the seconds of the whole command with the kept network. It needs the data of the
first call.

Materials and data of an earlier call are kept. Times mean little on a busy machine. The last line is a JSON
object.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.atomic import write_text
from mbtf_core.config_file import dump_yaml, read_yaml
from mbtf_core.units import clock

ROOT = Path(__file__).resolve().parents[1]
ASSETS = ROOT / "assets"
RELIEFS = ("cliff_rock", "insulation_foam", "straight_wool", "turtle_shell", "twisted_wool")
CLOTHS = ("basket_weave", "stockinette", "twill_silk")
# Factors of heights and of roughness, by the suffix of a variant's name.
VARIANTS = {"low": (0.5, 1.0), "smooth": (1.0, 0.5), "low_smooth": (0.5, 0.5)}
THRESHOLDS = {"seconds of twenty materials": 1200.0, "seconds with the kept network": 15.0, "ratio": 1.3}
MAPS = {"height": "height.exr", "base_color": "base_color.png", "roughness": "roughness.png"}


def variant(name: str, suffix: str, folder: Path) -> Path:
    """A material file that reads the maps of an asset with other heights or another roughness."""
    import OpenEXR

    height, roughness = VARIANTS[suffix]
    source = ASSETS / name
    described = read_yaml(source / "material.yaml") if (source / "material.yaml").is_file() else {}
    path = folder / f"{name}_{suffix}" / "material.yaml"
    maps: dict[str, Any] = {role: str(source / file) for role, file in MAPS.items()}
    maps["height"] = {"file": maps["height"], "scale": height}
    if roughness != 1.0:
        from PIL import Image

        with Image.open(source / MAPS["roughness"]) as image:
            values = np.asarray(image.convert("L"), np.float32)[..., None] / 255.0 * roughness
        path.parent.mkdir(parents=True, exist_ok=True)
        own = path.parent / "roughness.exr"
        header = {"type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, {"Y": values[..., 0]}) as out:
            out.write(str(own))
        maps["roughness"] = str(own)
    if "specular" in described:
        maps["specular"] = float(described["specular"])
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, dump_yaml(maps))
    return path.parent


def write_library(out: Path, count: int, training: str) -> Path:
    """The recipe of a library of some materials, the assets first."""
    pairs = [(name, suffix) for suffix in VARIANTS for name in RELIEFS]
    variants = [variant(name, suffix, out / "variants") for name, suffix in pairs]
    materials = [*(ASSETS / name for name in (*RELIEFS, *CLOTHS)), *variants][:count]
    if len(materials) < count:
        raise SystemExit(f"error: --materials: at most {len(materials)}")
    data = dict(read_yaml(ROOT / "pipelines" / "library.yaml"))
    data |= {"name": "benchmark", "title": f"{count} materials", "training": training}
    data["library"] = [os.path.relpath(path, out) for path in materials]
    data["description"] = "Assets, and variants of them with other heights and roughness."
    recipe = out / "library.yaml"
    write_text(recipe, dump_yaml(json.loads(json.dumps(data))))
    return recipe


def command(*words: object) -> tuple[dict[str, Any], float]:
    """What a command of the programs reports as JSON, and its seconds."""
    program = Path(sys.executable).parent / str(words[0])
    start = time.perf_counter()
    done = subprocess.run([str(program), *map(str, words[1:]), "--json"], stdout=subprocess.PIPE, check=False)
    seconds = time.perf_counter() - start
    if done.returncode:
        raise SystemExit(f"error: {' '.join(map(str, words))}: exit code {done.returncode}")
    return dict(json.loads(done.stdout)), seconds


def run_library(options: argparse.Namespace) -> tuple[dict[str, Any], bool]:
    """Figures of the whole library, and whether it met its threshold."""
    recipe = write_library(options.out, options.materials, options.training)
    words: list[object] = ["mbtf-pipeline", "run", recipe, "-o", options.out / "library"]
    words += ["--cluster", options.cluster] if options.cluster else []
    found, seconds = command(*words)
    stages: dict[str, float] = {}
    for material in found["materials"]:
        for stage, own in material["seconds"].items():
            stages[stage] = stages.get(stage, 0.0) + own
    print(f"{len(found['materials'])} materials in {clock(seconds)}; {found['page']}")
    for material in found["materials"]:
        errors = ", ".join(
            f"{name} {e['unexplained']['value']:.3g}" for name, e in material.get("fits", {}).items()
        )
        print(f"  {material['name']:28} {material['state']:8} {errors}")
    figures = {"materials": len(found["materials"]), "seconds": round(seconds, 1)}
    figures |= {f"seconds of {stage}": round(own, 1) for stage, own in stages.items()}
    return figures, options.materials > 20 or seconds <= THRESHOLDS["seconds of twenty materials"]


def unexplained(report: dict[str, Any]) -> tuple[float, float]:
    """Error of a fit's test split and its standard error."""
    found = (report["errors"].get("test") or report["errors"]["held_out_queries"])["unexplained"]
    return float(found["value"]), float(found["error"])


def fold(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """Errors of one material with the network of the others and with its own."""
    data = options.out / "library" / "materials"
    family = {name, *(f"{name}_{suffix}" for suffix in VARIANTS)}
    others = [
        run / "shards"
        for run in sorted(data.iterdir())
        if run.name not in family and run.name not in CLOTHS and (run / "shards" / "manifest.json").is_file()
    ]
    fits = options.out / "network" / options.model / name
    joint = [*others, "--shared-decoder", "--model", options.model, "--time", options.shared]
    command("mbtf-fit", "--many", *joint, "-o", fits / "others")
    shards = data / name / "shards"
    # Files that a fit has just written are still on their way to the disk.
    os.sync()
    keep = ["--decoder", fits / "others" / "decoder", "--time", options.time]
    kept, seconds = command("mbtf-fit", shards, *keep, "-o", fits / f"kept-{options.time}", "--overwrite")
    own, _ = command(
        "mbtf-fit",
        shards,
        *("--model", options.model, "--time", options.time, "-o", fits / f"own-{options.time}"),
        "--overwrite",
    )
    (a, a_bar), (b, b_bar) = unexplained(kept), unexplained(own)
    # Both errors are of the same test queries, so this bar of the ratio is an upper bound.
    bar = a / b * math.hypot(a_bar / a, b_bar / b)
    figures = {
        "materials of the network": len(others),
        "kept": [a, a_bar],
        "own": [b, b_bar],
        "ratio": [a / b, bar],
        "seconds": round(seconds, 2),
    }
    print(
        f"{name:18} {len(others):3} others: kept {a:.4f} ± {a_bar:.4f}, own {b:.4f} ± {b_bar:.4f}, "
        f"ratio {a / b:.2f} ± {bar:.2f}, {seconds:.1f} s"
    )
    return figures


def run_networks(options: argparse.Namespace) -> tuple[dict[str, Any], bool]:
    """Figures of all folds, and whether their means met the thresholds."""
    folds = {name: fold(name, options) for name in options.only or RELIEFS}
    ratios = [math.log(one["ratio"][0]) for one in folds.values()]
    mean = math.exp(float(np.mean(ratios)))
    slowest = max(one["seconds"] for one in folds.values())
    print(f"geometric mean of the ratios {mean:.3f}; the slowest command {slowest:.1f} s")
    figures = {"folds": folds, "geometric mean of the ratios": round(mean, 4), "slowest, s": slowest}
    met = mean <= THRESHOLDS["ratio"] and slowest <= THRESHOLDS["seconds with the kept network"]
    return figures, met


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder to work in")
    parser.add_argument("--materials", type=int, default=20, help="number of materials, at most 23")
    parser.add_argument("--training", default="5min", help="training time of all fits together")
    parser.add_argument("--cluster", help="as for mbtf-pipeline run")
    parser.add_argument("--network", action="store_true", help="measure kept networks")
    parser.add_argument("--model", default="relief", choices=("relief", "neumip"))
    parser.add_argument("--shared", default="2min", help="training time of the network of the others")
    parser.add_argument("--time", default="8s", help="training time of the new material")
    parser.add_argument("--only", nargs="*", choices=RELIEFS, help="new materials; all by default")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    figures, met = run_networks(options) if options.network else run_library(options)
    print(json.dumps({**figures, "thresholds": THRESHOLDS}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
