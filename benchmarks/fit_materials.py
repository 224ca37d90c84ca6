"""The models on eight materials: five of ``assets/`` and three texture sets that lie beside the project.

    python benchmarks/fit_materials.py --out FOLDER [--steps 1500] [--hierarchical STEPS] [--only NAME ...]

For each material two data sets of as many queries and paths are made at 64 × 64 texels, one per layout, and
``neumip`` and ``neumip-baseline`` are trained for ``--steps`` steps of 32 768 queries. Both are judged by the
same shuffled test queries. ``--hierarchical`` also trains ``hierarchical`` on windows of the image layout,
and ``neumip`` for as many steps; ``--direction-xyz`` also trains ``neumip`` with directions as (x, y, z).

What is reached depends on steps alone: the call may share its processor, may be interrupted, and goes on
where it was. Texture sets that are not there are skipped by name.

The last line is one JSON object: figures, and the bar: the offset network wins on every material.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from mbtf_core.data.dataset import Dataset
from mbtf_core.errors import MbtfError
from mbtf_fit import FitConfig, Material, fit
from mbtf_fit.data.loader import load_split
from mbtf_fit.evaluation import split_errors
from mbtf_gen.config.generator import GeneratorConfig

ROOT = Path(__file__).resolve().parents[1]
TEXTURE_SETS = ROOT.parent / "shared" / "data" / "materials"
# Folder and height of the relief in tile widths; None: as the material says.
MATERIALS: dict[str, tuple[Path, float | None]] = {
    **{
        name: (ROOT / "assets" / name, None)
        for name in ("cliff_rock", "insulation_foam", "straight_wool", "turtle_shell", "twisted_wool")
    },
    "rock_cliff": (TEXTURE_SETS / "rock_cliff", 0.12),
    "stone_bricks": (TEXTURE_SETS / "stone_bricks", 0.06),
    "tree_bark": (TEXTURE_SETS / "tree_bark", 0.1),
}
# Places along each side of a buffer of the image layout.
WINDOW = 4


def make_data(name: str, folder: Path, layout: str) -> Path:
    """A material's data set of one layout, resumed where it is unfinished."""
    from mbtf_gen.generation.run import generate

    material, height = MATERIALS[name]
    queries: dict[str, Any] = {
        "train": "600/texel",
        "spp": 4,
        "resolution": 64,
        "min_cos": 0.2,
        "test_spp": 256,
    }
    queries |= {"test": "16384"} if layout == "shuffled" else {"test": "256", "layout": "image"}
    if layout == "image":
        queries["patch_size"] = WINDOW
    config = GeneratorConfig.model_validate(
        {
            "material": str(material),
            "geometry": {"height_scale": height, "mesh": 256},
            "queries": queries,
            "light": {"width": 3},
        }
    )
    generate(config, folder)
    return folder


# Options of a model, under the name that its figures have.
XYZ = "neumip-xyz"
OPTIONS: dict[str, dict[str, Any]] = {
    XYZ: {"model": "neumip", "network": {"encoding": {"direction_xyz": True}}},
}


def train(name: str, model: str, steps: int, out: Path) -> dict[str, Any]:
    """Figures of one model on one material."""
    layout = "image" if model == "hierarchical" else "shuffled"
    judge = make_data(name, out / f"{name}-shuffled", "shuffled")
    shards = judge if layout == "shuffled" else make_data(name, out / f"{name}-image", "image")
    options = OPTIONS.get(model, {"model": model})
    config = FitConfig.model_validate({**options, "training": {"steps": steps}})

    def progress(share: float, note: str) -> None:
        print(f"{name} {model} {share:4.0%} {note}", file=sys.stderr)

    result = fit(config, shards, out / f"{name}-{model}-{steps}", progress=progress)
    test = result.errors["test"]
    if layout == "image":
        truth = Dataset.open(judge)
        found = split_errors(Material.load(result.folder).predict, load_split(truth, "test"), truth.lattice)
        assert found is not None
        test = found.as_dict()
    return {
        "unexplained": test["unexplained"],
        "levels": {level: e["unexplained"]["value"] for level, e in test["levels"].items()},
        "training": result.errors["training"]["unexplained"]["value"],
        "seconds": result.seconds,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder to work in")
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--hierarchical", type=int, help="steps of hierarchical; not trained by default")
    parser.add_argument("--direction-xyz", action="store_true", help=f"train {XYZ}, too")
    parser.add_argument("--only", nargs="*", choices=list(MATERIALS), help="of these; all by default")
    arguments = parser.parse_args()
    record = arguments.out / "materials.json"
    arguments.out.mkdir(parents=True, exist_ok=True)
    found: dict[str, Any] = json.loads(record.read_text()) if record.exists() else {}
    runs = [("neumip-baseline", arguments.steps), ("neumip", arguments.steps)]
    if arguments.direction_xyz:
        runs.append((XYZ, arguments.steps))
    if arguments.hierarchical:
        runs += [("neumip", arguments.hierarchical), ("hierarchical", arguments.hierarchical)]
    for name in arguments.only or MATERIALS:
        if not MATERIALS[name][0].exists():
            print(f"{name}: skipped, {MATERIALS[name][0]} is not there")
            continue
        for model, steps in runs:
            key = f"{name} {model} {steps}"
            try:
                if key not in found:
                    found[key] = train(name, model, steps, arguments.out)
                    record.write_text(json.dumps(found))
            except MbtfError as error:
                print(f"error: {error.message}", file=sys.stderr)
                return error.exit_code
    lost = []
    for key, figures in found.items():
        u = figures["unexplained"]
        levels = " ".join(f"{value:.2f}" for value in figures["levels"].values())
        print(f"{key:36s} {u['value']:.3f} ± {u['error']:.3f}   by level {levels}")
        name, model, steps = key.split()
        if model == "neumip-baseline":
            mine = found.get(f"{name} neumip {steps}")
            if mine is not None and not mine["unexplained"]["value"] < u["value"]:
                lost.append(name)
    print(json.dumps({"figures": found, "offset_loses": lost, "met": not lost}))
    return 1 if lost else 0


if __name__ == "__main__":
    sys.exit(main())
