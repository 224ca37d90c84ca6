"""Error against time of many configurations of the fitter, on one data set.

    python benchmarks/fit_sweep.py [--shards FOLDER] [--out FOLDER] [--time 100s] [--only NAME ...]

Without ``--shards`` the yardstick's data set is made first (minutes; its maps lie beside the project). Every
configuration of `SWEEP` is trained for the same time and judged on the test split: unexplained variance,
noise-free. Prints one line each, and writes ``sweep.png`` (error of the held-out queries over seconds) and
``sweep.json`` into ``--out``; configurations that the file already holds are not trained again, so that a
sweep may be made in parts.

The last line is one JSON object with the figures; the bar: no other configuration of a model of the default's
size is clearly better than the default.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from yardstick import make_shards

from mbtf_fit import FitConfig, fit, read_history
from mbtf_gen.errors import MbtfError

# What differs from the default.
SWEEP: dict[str, dict[str, Any]] = {
    "default": {},
    "wide": {"network": {"width": 48}},
    "channels": {"network": {"channels": 12}},
    "batch 2^13": {"training": {"batch": 1 << 13}},
    "batch 2^17": {"training": {"batch": 1 << 17}},
    "rate / 3": {"training": {"rate": 1e-2, "texture_rate": 3e-3}},
    "textures x 3": {"training": {"texture_rate": 3e-2}},
    "squared": {"training": {"losses": [{"kind": "squared"}]}},
    "log": {"training": {"losses": [{"kind": "log"}]}},
    "log + linear, as published": {
        "training": {
            "losses": [{"kind": "log"}, {"kind": "linear", "weight": 0.1}],
            "correction": "none",
            "robust": None,
        }
    },
    "no blur": {"training": {"blur": {"start": 0.0}}},
    "baseline": {"model": "neumip-baseline"},
}
# Configurations of the default's size and model: the default is held against them.
ALIKE = [name for name in SWEEP if name not in ("wide", "channels")]
# How much better, in standard errors and in share of the variance, counts as clearly better.
ERRORS, SHARE = 3.0, 0.01


def train(name: str, shards: Path, out: Path, time: str) -> dict[str, Any]:
    """Figures of one configuration."""
    options = json.loads(json.dumps(SWEEP[name]))
    options.setdefault("training", {})["time"] = time
    folder = out / name.replace(" ", "-").replace("/", "per").replace("^", "")

    def progress(share: float, note: str) -> None:
        print(f"{name} {share:4.0%} {note}", file=sys.stderr)

    result = fit(FitConfig.model_validate(options), shards, folder, overwrite=True, progress=progress)
    training, test = result.material.description["training"], result.errors["test"]
    history = [(r["seconds"], r["held_out"]) for r in read_history(folder) if r["held_out"] is not None]
    return {
        "unexplained": test["unexplained"],
        "levels": {level: e["unexplained"]["value"] for level, e in test["levels"].items()},
        "training": result.errors["training"]["unexplained"]["value"],
        "queries_per_second": round(training["steps"] * training["batch"] / result.seconds),
        "seconds": result.seconds,
        "history": history,
    }


def plot(found: dict[str, dict[str, Any]], path: Path) -> None:
    """Error of the held-out queries over seconds, a curve each."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 5.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for k, (name, figures) in enumerate(found.items()):
        if figures["history"]:
            seconds, errors = zip(*figures["history"], strict=True)
            style = "-" if k < 10 else "--"
            axes.plot(seconds, errors, style, label=name, linewidth=2.5 if name == "default" else 1.2)
    axes.set_yscale("log")
    axes.set_xlabel("seconds of training")
    axes.set_ylabel("unexplained variance, held-out queries")
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=110)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--shards", type=Path, help="data set; the yardstick's by default")
    parser.add_argument("--out", type=Path, help="folder to work in; a temporary one by default")
    parser.add_argument("--time", default="100s", help="training time of each")
    parser.add_argument("--only", nargs="*", choices=list(SWEEP), help="of these; all by default")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        out = arguments.out or Path(temporary)
        out.mkdir(parents=True, exist_ok=True)
        record = out / "sweep.json"
        found: dict[str, dict[str, Any]] = json.loads(record.read_text()) if record.exists() else {}
        try:
            shards = arguments.shards or make_shards(out / "shards")
            for name in arguments.only or SWEEP:
                if name not in found:
                    found[name] = train(name, shards, out, arguments.time)
                    record.write_text(json.dumps(found))
        except MbtfError as error:
            print(f"error: {error.message}", file=sys.stderr)
            return error.exit_code
        plot(found, out / "sweep.png")
    for name, figures in found.items():
        u, speed = figures["unexplained"], figures["queries_per_second"] / 1e6
        print(
            f"{name:28s} {u['value']:.3f} ± {u['error']:.3f}   training {figures['training']:.3f}"
            f"   {speed:.2f} M queries/s"
        )
    better: list[str] = []
    if "default" in found:
        mine = found["default"]["unexplained"]
        for name in (n for n in ALIKE if n in found):
            other = found[name]["unexplained"]
            error = (mine["error"] ** 2 + other["error"] ** 2) ** 0.5
            if mine["value"] - other["value"] > max(SHARE, ERRORS * error):
                better.append(name)
    figures = {name: {k: v for k, v in f.items() if k != "history"} for name, f in found.items()}
    print(json.dumps({"figures": figures, "better_than_default": better, "met": not better}))
    return 0 if not better else 1


if __name__ == "__main__":
    sys.exit(main())
