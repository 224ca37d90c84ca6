"""A library of small materials on this machine: seconds of the whole command, and of its stages.

    python benchmarks/library.py --out FOLDER [--materials 20] [--training 5min] [--cluster local]

The materials are the assets and variants of them: half the height, a smoother surface, or both.

Materials and data of an earlier call are kept. Times mean little on a busy machine. The last line is a JSON
object.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.atomic import write_text
from mbtf_core.config.yaml_file import dump_yaml, read_yaml
from mbtf_core.units import clock

ROOT = Path(__file__).resolve().parents[1]
ASSETS = ROOT / "assets"
RELIEFS = ("cliff_rock", "insulation_foam", "straight_wool", "turtle_shell", "twisted_wool")
CLOTHS = ("basket_weave", "stockinette", "twill_silk")
# Factors of heights and of roughness, by the suffix of a variant's name.
VARIANTS = {"low": (0.5, 1.0), "smooth": (1.0, 0.5), "low_smooth": (0.5, 0.5)}
THRESHOLDS = {"seconds of twenty materials": 1200.0}
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


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder to work in")
    parser.add_argument("--materials", type=int, default=20, help="number of materials, at most 23")
    parser.add_argument("--training", default="5min", help="training time of all fits together")
    parser.add_argument("--cluster", help="as for mbtf-pipeline run")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    figures, met = run_library(options)
    print(json.dumps({**figures, "thresholds": THRESHOLDS}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
