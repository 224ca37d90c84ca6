"""The hierarchical model against NeuMIP on one material: error after equal steps and after equal time.

    python benchmarks/hierarchical_trial.py --out FOLDER [--steps 300 1000 3000] [--only NAME ...]

All data sets have as many queries and paths, of the same distributions. ``shuffled/`` has the test queries of
all fits. Each number of steps is a fit of its own, whose learning rate falls to its end. Seconds are the
processor time of a step on one thread, the median of some, times the number of steps. Fits marked ``*`` have
as many steps as take the time of ``hierarchical``.

Interrupted runs resume. ``--curve`` prints the validation errors during each fit. The last line is one JSON
object.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mbtf_core.data.dataset import Dataset
from mbtf_core.errors import MbtfError
from mbtf_fit import FitConfig, Material, fit
from mbtf_fit.data.loader import load_split, load_training, open_data
from mbtf_fit.evaluation import split_errors
from mbtf_fit.models.registry import MODELS
from mbtf_fit.training.fit import prepare_trainer
from mbtf_fit.training.validation import read_history
from mbtf_gen.config.generator import GeneratorConfig

ROOT = Path(__file__).resolve().parents[1]
PAPER_ENCODING = {"direction_pi": True, "band_attenuation": False, "footprint_filtered": False}
# L1 of fourth roots; that of their differences joins after a quarter of the training.
PAPER_LOSSES = [{"kind": "fourth-root"}, {"kind": "gradient", "start": 0.25}]
PLAIN = {"position": 0, "direction": 0}
FITS: dict[str, dict[str, Any]] = {
    "hierarchical": {"model": "hierarchical"},
    "neumip": {"model": "neumip"},
    # The network of neumip, on the data of hierarchical.
    "neumip-images": {
        "model": "hierarchical",
        "network": {
            "decoder": "mlp",
            "output_transform": "expm1",
            "encoding": {"position": 0, "direction": 0},
        },
    },
    "mlp": {"model": "hierarchical", "network": {"decoder": "mlp"}},
    "paper": {
        "model": "hierarchical",
        "network": {"encoding": PAPER_ENCODING},
        "training": {"losses": PAPER_LOSSES, "correction": "none"},
    },
    "paper-encoding": {"model": "hierarchical", "network": {"encoding": PAPER_ENCODING}},
    "paper-loss": {"model": "hierarchical", "training": {"losses": PAPER_LOSSES, "correction": "none"}},
}
# Steps that are timed, and fits that also get the time of `hierarchical`.
TIMED, EQUAL_TIME = 12, ("neumip", "mlp")


def make_data(folder: Path, layout: str, arguments: argparse.Namespace) -> Path:
    """A data set of one layout, resumed where it is unfinished."""
    from mbtf_gen.generation.run import generate

    queries: dict[str, Any] = {
        "train": arguments.queries,
        "spp": 4,
        "resolution": arguments.resolution,
        "min_cos": 0.2,
        "test": "16384" if layout == "shuffled" else "4096",
        "test_spp": 256,
        "layout": layout,
    }
    if layout == "image":
        queries["patch_size"] = arguments.patch_size
    config = GeneratorConfig.model_validate(
        {
            "material": str(ROOT / "assets" / arguments.material),
            "geometry": {"mesh": 256},
            "queries": queries,
            "light": {"width": 3},
        }
    )
    generate(config, folder)
    return folder


def config_of(name: str, steps: int) -> FitConfig:
    options = FITS[name]
    return FitConfig.model_validate({**options, "training": {**options.get("training", {}), "steps": steps}})


def step_seconds(name: str, shards: Path) -> float:
    """Processor time of a training step on one thread, batch included."""
    config = config_of(name, 1000)
    data = open_data(shards, MODELS[config.model].layout, config.model)
    part = load_training(data, config.held_out, config.seed)
    trainer = prepare_trainer(config, data, part, torch.device("cpu"))
    # A term that starts later counts in the mean.
    seconds = []
    for fraction in (0.0, 0.5):
        trainer.progress.step = round(1000 * fraction)
        for _ in range(TIMED):
            start = time.process_time()
            trainer.train(0.0)
            seconds.append(time.process_time() - start)
    first, later = np.median(seconds[1:TIMED]), np.median(seconds[TIMED + 1 :])
    return float(0.25 * first + 0.75 * later)


def train(name: str, steps: int, shards: Path, shuffled: Dataset, out: Path) -> dict[str, Any]:
    """Errors of one fit, on the shuffled test queries."""

    def progress(share: float, note: str) -> None:
        print(f"{name} {steps} {share:4.0%} {note}", file=sys.stderr)

    result = fit(config_of(name, steps), shards, out / f"{name}-{steps}", progress=progress)
    found = split_errors(Material.load(result.folder).predict, load_split(shuffled, "test"), shuffled.lattice)
    assert found is not None
    errors = found.as_dict()
    return {
        "unexplained": errors["unexplained"],
        "levels": {level: e["unexplained"]["value"] for level, e in errors["levels"].items()},
        "training": result.errors["training"]["unexplained"]["value"],
    }


def print_table(found: dict[str, dict[str, Any]]) -> None:
    """One line per fit, in the order of their time."""
    for key, figures in sorted(found.items(), key=lambda item: item[1]["seconds"]):
        name, steps = key.split()
        mark = "*" if figures["equal_time"] else " "
        u, levels = figures["unexplained"], " ".join(f"{v:.2f}" for v in figures["levels"].values())
        print(
            f"{name:16s}{steps:>7s}{mark} steps {figures['seconds']:7.0f} s   "
            f"{u['value']:.4f} ± {u['error']:.4f}   training {figures['training']:.4f}   by level {levels}"
        )


def print_curves(found: dict[str, dict[str, Any]], out: Path) -> None:
    """Validation errors at some fractions of each fit."""
    for key in found:
        print(key)
        history = read_history(out / key.replace(" ", "-"))
        for record in history[:: max(1, len(history) // 15)]:
            error = record["unexplained"], record["unexplained_error"]
            print(
                f"  step {record['step']:6d}  loss {record['loss']:.4f}  " + "{:.4f} ± {:.4f}".format(*error)
            )


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder to work in")
    parser.add_argument("--material", default="twisted_wool", help="a folder of assets/")
    parser.add_argument("--resolution", type=int, default=64)
    parser.add_argument("--queries", default="1600/texel")
    parser.add_argument("--patch-size", type=int, default=16, help="texels along each side of an image")
    parser.add_argument("--steps", type=int, nargs="*", default=[300, 1000, 3000])
    parser.add_argument("--only", nargs="*", choices=list(FITS), default=list(FITS))
    parser.add_argument("--threads", type=int, default=1, help="of the fits; steps are timed on one")
    parser.add_argument("--curve", action="store_true", help="print validation errors during the fits")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    out = arguments.out
    record = out / "trial.json"
    try:
        shards = {layout: make_data(out / layout, layout, arguments) for layout in ("shuffled", "image")}
        shuffled = Dataset.open(shards["shuffled"])
        folders = {name: shards[MODELS[FITS[name]["model"]].layout] for name in FITS}
        found: dict[str, Any] = json.loads(record.read_text()) if record.exists() else {}
        seconds = {name: step_seconds(name, folders[name]) for name in {*arguments.only, "hierarchical"}}
        torch.set_num_threads(arguments.threads)
        for name, each in seconds.items():
            print(f"{name}: {1e3 * each:.1f} ms per step", file=sys.stderr)
        runs: list[tuple[str, int, bool]] = []
        for steps in arguments.steps:
            runs += [(name, steps, False) for name in arguments.only]
            for name in sorted({*EQUAL_TIME} & {*arguments.only}):
                equal = float(f"{steps * seconds['hierarchical'] / seconds[name]:.2g}")
                runs.append((name, int(equal), True))
        for name, steps, equal_time in runs:
            key = f"{name} {steps}"
            if key not in found:
                found[key] = train(name, steps, folders[name], shuffled, out)
                found[key] |= {"seconds": steps * seconds[name], "equal_time": equal_time}
                record.write_text(json.dumps(found))
    except MbtfError as error:
        print(f"error: {error.message}", file=sys.stderr)
        return error.exit_code
    print_table(found)
    if arguments.curve:
        print_curves(found, out)
    print(json.dumps({"step_seconds": seconds, "figures": found}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
