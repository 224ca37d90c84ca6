"""Error against time of many configurations of the fitter, on the data of the benchmark rock_cliff-128.

    python benchmarks/fit_sweep.py --out FOLDER --rates                  # a quiet machine for half a minute
    python benchmarks/fit_sweep.py --out FOLDER [--seconds 20] [--only NAME ...]

The first call measures how long a step of each configuration takes, at ten moments of the annealing, and
writes ``rates.json``; the second trains each for as many steps as take ``--seconds`` by these rates. What a
fit reaches depends on its steps alone, so the second call may share its processor with others, may be
interrupted, and goes on where it was: ``sweep.json`` keeps what is done. Without ``rates.json`` they are
measured first.

Every configuration is evaluated on the test split of the benchmark: unexplained variance. Data sets
are made where they are missing (minutes; the maps lie beside the project); some configurations train on other
ones, made of as many paths. Prints one line each, and writes ``sweep.png``, error while training over
seconds.

The last line is one JSON object with the figures; the bar: no configuration of the default's model and
evaluation cost is clearly better than the default.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from fit import MOMENTS, random_batch
from rock_cliff_128 import RECIPE, make_shards

from mbtf_core.errors import MbtfError
from mbtf_core.lattice import Lattice
from mbtf_fit import FitConfig, Material, fit, read_history
from mbtf_fit.config import build_model
from mbtf_fit.data.loader import Partition, load_split, load_training, open_data
from mbtf_fit.evaluation import split_errors
from mbtf_fit.objective.noise import NoiseModel
from mbtf_fit.objective.parallel import MAX_KERNEL_THREADS, MAX_THREADS, Workers
from mbtf_fit.training.trainer import Trainer
from mbtf_gen.dataset.reader import Dataset

PUBLISHED = [{"kind": "log"}, {"kind": "linear", "weight": 0.1}]
# Directions as (x, y, z).
XYZ = {"direction_xyz": True}
SMOOTHED: dict[str, Any] = {"texture_weight_decay": 1.0, "blur": {"min_sigma": 0.8}}
# What differs from the default; "queries" differs in the data.
SWEEP: dict[str, dict[str, Any]] = {
    "default": {},
    "baseline": {"model": "neumip-baseline"},
    "batch 2^13": {"training": {"batch": 1 << 13}},
    "batch 2^17": {"training": {"batch": 1 << 17}},
    "rates / 3": {"training": {"learning_rate": 1e-2, "texture_learning_rate": 3e-3}},
    "textures x 3": {"training": {"texture_learning_rate": 3e-2}},
    "squared": {"training": {"losses": [{"kind": "squared"}]}},
    "as published": {
        "training": {
            "losses": PUBLISHED,
            "correction": "none",
            "huber_delta": None,
            "noise_regularization": 0.0,
        }
    },
    "no blur": {"training": {"blur": {"initial_sigma": 0.0}}},
    "longer blur": {"training": {"blur": {"fraction": 0.9}}},
    "200/texel, 16 paths": {"queries": {"train": "200/texel", "spp": 16}},
    "40 % at the finest": {"queries": {"mixture": {"log_uniform": 0.6, "finest": 0.4}}},
    "width 40, channels 12": {"network": {"width": 40, "channels": 12}},
    "direction_xyz": {"network": {"encoding": XYZ}},
    "lifted, smoothed": {"network": {"encoding": XYZ}, "training": SMOOTHED},
    "lifted, 40, 12": {"network": {"width": 40, "channels": 12, "encoding": XYZ}},
    "lifted, 40, 12, smoothed": {
        "network": {"width": 40, "channels": 12, "encoding": XYZ},
        "training": SMOOTHED,
    },
}
# Configurations whose model is not the default's.
OTHER = [name for name, options in SWEEP.items() if options.keys() & {"model", "network"}]
# How much better, in standard errors and in share of the variance, counts as clearly better.
ERRORS, SHARE = 3.0, 0.01
# Steps per moment whose time is taken, and rounds of which the median counts.
STEPS, ROUNDS = 2, 3


def configuration(name: str, **training: Any) -> FitConfig:
    """A configuration of the sweep."""
    options = json.loads(json.dumps({k: v for k, v in SWEEP[name].items() if k != "queries"}))
    options.setdefault("training", {}).update(training)
    return FitConfig.model_validate({"model": "neumip", **options})


def seconds_per_step(name: str, lattice: Lattice) -> float:
    """Mean over training, median of some rounds."""
    config = configuration(name, steps=10_000)
    queries = random_batch(np.random.default_rng(0), config.training.batch, lattice)
    model = build_model(config.model, lattice, **config.network.model_dump())
    import torch

    model.initialize(torch.Generator().manual_seed(0), 0.2)
    trainer = Trainer(config, model, queries, NoiseModel.silent(0.2, lattice))
    found = []
    limit = MAX_THREADS if trainer.backend == "pytorch" else MAX_KERNEL_THREADS
    with Workers(torch.device("cpu"), limit=limit) as workers:
        for _ in range(ROUNDS + 1):
            start = time.perf_counter()
            for moment in MOMENTS:
                trainer.progress.step = round(10_000 * moment)
                for _ in range(STEPS):
                    trainer._step(queries, workers)
            found.append((time.perf_counter() - start) / (STEPS * len(MOMENTS)))
    return statistics.median(found[1:])


def arithmetic(name: str) -> str:
    """What a step of a configuration computes: the same text, the same time."""
    fields = configuration(name).fields()
    for key in ("learning_rate", "texture_learning_rate", "time", "steps", "warmup"):
        del fields["training"][key]
    kinds = {term["kind"] for term in fields["training"]["losses"]}
    fields["training"]["losses"] = sorted("relative" if kind == "squared" else kind for kind in kinds)
    return json.dumps(fields, sort_keys=True)


def measure_rates(names: list[str]) -> dict[str, float]:
    """Seconds per step by name; configurations of the same arithmetic share the median of theirs."""
    found = {}
    for name in names:
        found[name] = seconds_per_step(name, Lattice(7))
        print(f"{name}: {found[name] * 1e3:.2f} ms per step", file=sys.stderr)
    alike = {name: [n for n in names if arithmetic(n) == arithmetic(name)] for name in names}
    return {name: statistics.median(found[n] for n in alike[name]) for name in names}


class Data:
    """The data sets of the sweep, made and read once."""

    def __init__(self, out: Path, shards: Path | None) -> None:
        self.out, self.given = out, shards
        self._kept: tuple[Path, Partition] | None = None

    def folder(self, name: str = "default") -> Path:
        """Shards that a configuration is trained on."""
        queries = SWEEP[name].get("queries")
        if queries is None:
            return self.given or make_shards(self.out / "shards")
        from mbtf_gen.generation import generate
        from mbtf_pipeline.recipe import load_recipe

        config = load_recipe(RECIPE).generate
        plain = config.model_dump(mode="json")
        plain["queries"] |= {"test": "1024", "test_spp": 16} | queries
        folder = self.out / f"shards {name}".replace(" ", "-").replace("/", "per").replace(",", "")
        generate(type(config).model_validate(plain), folder)
        return folder

    def partition(self, folder: Path, config: FitConfig) -> Partition:
        """A train split, divided; the last one is kept."""
        if self._kept is None or self._kept[0] != folder:
            self._kept = None
            data = open_data(folder, "shuffled", config.model)
            self._kept = (folder, load_training(data, config.held_out, config.seed))
        return self._kept[1]


def train(name: str, data: Data, out: Path, seconds: float, per_step: float) -> dict[str, Any]:
    """Figures of one configuration."""
    config = configuration(name, steps=max(1, round(seconds / per_step)))
    folder = out / name.replace(" ", "-").replace("/", "per").replace("^", "").replace(",", "")
    shards = data.folder(name)

    def progress(share: float, note: str) -> None:
        print(f"{name} {share:4.0%} {note}", file=sys.stderr)

    result = fit(config, shards, folder, progress=progress, partition=data.partition(shards, config))
    truth = Dataset.open(data.folder())
    test = split_errors(Material.load(folder).predict, load_split(truth, "test"), truth.lattice)
    assert test is not None
    history = [(r["step"] * per_step, r["unexplained"]) for r in read_history(folder) if r["unexplained"]]
    return {
        "unexplained": test.overall.unexplained.as_dict(),
        "levels": {level: e.unexplained.value for level, e in test.levels.items()},
        "training": result.errors["training"]["unexplained"]["value"],
        "held_out_queries": result.errors["held_out_queries"]["unexplained"]["value"],
        "steps": config.training.steps,
        "queries_per_second": round(config.training.batch / per_step),
        "seconds": seconds,
        "history": history,
    }


def plot(found: dict[str, dict[str, Any]], path: Path) -> None:
    """Error while training over seconds, a curve each."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullLocator

    figure = Figure(figsize=(9, 5.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for k, (name, figures) in enumerate(found.items()):
        if figures["history"]:
            seconds, errors = zip(*figures["history"], strict=True)
            style = ("-", "--", ":")[k // 10]
            label = f"{figures['unexplained']['value']:.3f}  {name}"
            axes.plot(seconds, errors, style, label=label, linewidth=2.5 if name == "default" else 1.2)
    axes.set_yscale("log")
    lowest = min(error for figures in found.values() for _, error in figures["history"])
    axes.set_ylim(0.9 * lowest, 0.8)
    axes.set_yticks([y for y in (0.1, 0.15, 0.2, 0.3, 0.4, 0.6) if y > 0.9 * lowest], minor=False)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_xlabel("seconds of training")
    axes.set_ylabel("unexplained variance while training")
    axes.grid(alpha=0.3, which="both")
    axes.legend(loc="upper right", fontsize=8, title="test split")
    figure.savefig(path, dpi=110)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--shards", type=Path, help="data set of the benchmark; made by default")
    parser.add_argument("--out", type=Path, help="folder to work in; a temporary one by default")
    parser.add_argument("--seconds", type=float, default=20.0, help="training time of each")
    parser.add_argument("--rates", action="store_true", help="measure the time of steps, no more")
    parser.add_argument("--only", nargs="*", choices=list(SWEEP), help="of these; all by default")
    arguments = parser.parse_args()
    names = arguments.only or list(SWEEP)
    with tempfile.TemporaryDirectory() as temporary:
        out = arguments.out or Path(temporary)
        out.mkdir(parents=True, exist_ok=True)
        rates_file, record = out / "rates.json", out / "sweep.json"
        rates: dict[str, float] = json.loads(rates_file.read_text()) if rates_file.exists() else {}
        found: dict[str, dict[str, Any]] = json.loads(record.read_text()) if record.exists() else {}
        try:
            rates |= measure_rates([n for n in names if n not in rates or arguments.rates])
            rates_file.write_text(json.dumps(rates))
            if arguments.rates:
                print(json.dumps(rates))
                return 0
            data = Data(out, arguments.shards)
            for name in names:
                if found.get(name, {}).get("seconds") != arguments.seconds:
                    found[name] = train(name, data, out, arguments.seconds, rates[name])
                    record.write_text(json.dumps(found))
        except MbtfError as error:
            print(f"error: {error.message}", file=sys.stderr)
            return error.exit_code
        found = {name: found[name] for name in SWEEP if name in found}
        plot(found, out / "sweep.png")
    for name, figures in found.items():
        u, speed = figures["unexplained"], figures["queries_per_second"] / 1e6
        print(
            f"{name:22s} {u['value']:.3f} ± {u['error']:.3f}   held out {figures['held_out_queries']:.3f}"
            f"   training {figures['training']:.3f}   {speed:.2f} M queries/s"
        )
    better: list[str] = []
    if "default" in found:
        mine = found["default"]["unexplained"]
        for name in (n for n in found if n not in OTHER):
            other = found[name]["unexplained"]
            bar = (mine["error"] ** 2 + other["error"] ** 2) ** 0.5
            if mine["value"] - other["value"] > max(SHARE, ERRORS * bar):
                better.append(name)
    figures = {name: {k: v for k, v in f.items() if k != "history"} for name, f in found.items()}
    print(json.dumps({"figures": figures, "better_than_default": better, "met": not better}))
    return 0 if not better else 1


if __name__ == "__main__":
    sys.exit(main())
