"""What a cluster of workers costs, and how long a library of materials would take on one.

    python benchmarks/cluster.py [--workers 2] [--tasks 60] [--empty 2000] [--material PATH]

Measures, on a local cluster of Dask: the start of the workers; the time per empty task, which bounds the
tasks per second of a scheduler; the overhead of one-second tasks; a data set by one process and by the
workers; and the rate at which shards are written. From these it projects the time of a library: `--library`
materials of `--paths` paths each, and a fit of `--fit-seconds` per material, on 1 to 4096 workers of the
kind measured. The last line is a JSON object.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.run.cluster import open_runner
from mbtf_core.run.runner import Runner
from mbtf_core.run.task import Item, TaskFunction
from mbtf_core.units import clock
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.dataset.reader import Dataset
from mbtf_gen.dataset.shard_io import row_bytes, write_shard
from mbtf_gen.dataset.sidecar import finished_record
from mbtf_gen.generation import generate

ASSETS = Path(__file__).parents[1] / "assets"
WORKERS = (1, 16, 256, 4096)
THRESHOLDS = {"overhead of one-second tasks": 0.05}
# Paths per query and queries per shard: the defaults.
SPP, SHARD_QUERIES = 4, 1 << 18


def timed(act: Callable[[], Any]) -> float:
    start = time.perf_counter()
    act()
    return time.perf_counter() - start


def wait(seconds: float) -> None:
    """A task that only takes time; workers import it from this file."""
    time.sleep(seconds)


def run_tasks(runner: Runner, count: int, function: TaskFunction, arguments: dict[str, Any]) -> float:
    """Seconds of some equal items."""
    items = [Item(f"item-{i}", arguments) for i in range(count)]

    def run() -> None:
        for done in runner.map(function, items):
            assert not done.error, done.error

    return timed(run)


def shard_seconds(folder: Path) -> list[float]:
    """Seconds of each training shard, by its sidecar."""
    data = Dataset.open(folder)
    records = [finished_record(folder, e, data.manifest["config_hash"]) for e in data.entries("train")]
    return [record["seconds"] for record in records if record is not None]


def writing_rate(folder: Path) -> float:
    """MB/s of writing shards, until they are on the disk."""
    folder.mkdir()
    n = SHARD_QUERIES
    direction = np.tile(np.array([0, 0, 1], np.float32), (n, 1))
    arrays = {
        **{"u": np.zeros((n, 2), np.float32), "sigma": np.ones(n, np.float32)},
        **{"omega_i": direction, "omega_o": direction, "spp": np.full(n, SPP, np.float32)},
        **{name: np.zeros((n, 3), np.float32) for name in ("value_a", "value_b")},
    }
    seconds = [timed(lambda i=i: write_shard(folder / f"train-{i:05d}.npz", arrays)) for i in range(5)]  # type: ignore[misc]
    return n * row_bytes(False) / 1e6 / float(np.median(seconds))


def projected(figures: dict[str, float], options: argparse.Namespace, workers: int) -> dict[str, Any]:
    """Time of the library on a number of workers, and what it waits for.

    Shards and fits are spread evenly. The scheduler and the storage work beside the workers, so that the
    slowest of the three decides; start-up and the last fit come on top.
    """
    shards = options.library * math.ceil(options.paths / (SPP * SHARD_QUERIES))
    queries = options.library * options.paths / SPP
    rendering = options.library * options.paths / figures["paths/s of a worker"]
    fitting = options.library * options.fit_seconds
    bounds = {
        "workers": (rendering + fitting) / workers,
        "scheduler": (shards + options.library) * figures["seconds per empty task"],
        "storage": queries * row_bytes(False) / 1e6 / options.storage,
    }
    slowest = max(bounds, key=lambda name: bounds[name])
    start = figures["seconds of a worker's start"] + figures["seconds before its first shard"]
    tail = options.fit_seconds if workers > 1 else 0.0
    seconds = start + bounds[slowest] + tail
    return {
        "workers": workers,
        "seconds": round(seconds),
        "worker hours": round(workers * seconds / 3600, 1),
        "efficiency": round(bounds["workers"] / seconds, 3),
        "limited by": slowest,
    }


def main() -> int:
    # Workers know this file by its name.
    from cluster import wait as wait_on_worker

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--tasks", type=int, default=60, help="one-second tasks")
    parser.add_argument("--empty", type=int, default=2000, help="empty tasks")
    parser.add_argument("--material", default=str(ASSETS / "turtle_shell"))
    parser.add_argument("--queries", type=int, default=16 * SHARD_QUERIES)
    parser.add_argument("--library", type=int, default=1000, help="materials of the projection")
    parser.add_argument("--paths", type=float, default=1e8, help="paths per material")
    parser.add_argument("--fit-seconds", type=float, default=600.0, help="training per material")
    parser.add_argument("--storage", type=float, help="MB/s of the shared storage; default: as measured here")
    options = parser.parse_args()
    figures: dict[str, float] = {}
    config = GeneratorConfig.model_validate(
        {
            "material": options.material,
            "queries": {"train": str(options.queries), "test": "1024", "spp": SPP, "test_spp": 8},
        }
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        start = time.perf_counter()
        with open_runner(f"local:{options.workers}", print) as runner:
            figures["seconds of a worker's start"] = round(time.perf_counter() - start, 2)
            empty = run_tasks(runner, options.empty, clock, {"seconds": 0.0})
            figures["seconds per empty task"] = round(empty / options.empty, 6)
            each = run_tasks(runner, options.tasks, wait_on_worker, {"seconds": 1.0})
            ideal = math.ceil(options.tasks / options.workers)
            figures["overhead of one-second tasks"] = round(each / ideal - 1.0, 4)
            clustered = timed(lambda: generate(config, folder / "cluster", runner=runner))
        plain = timed(lambda: generate(config, folder / "plain"))
        seconds = shard_seconds(folder / "cluster")
        figures["data set by one process, s"] = round(plain, 2)
        figures["data set by the workers, s"] = round(clustered, 2)
        median = float(np.median(seconds))
        figures["seconds of a shard on a worker"] = round(median, 3)
        figures["seconds before its first shard"] = round(clustered - sum(seconds) / options.workers, 2)
        figures["paths/s of a worker"] = round(SPP * SHARD_QUERIES / median)
        figures["MB/s of writing"] = round(writing_rate(folder / "writing"), 1)
    if options.storage is None:
        options.storage = figures["MB/s of writing"]
    for key, value in figures.items():
        print(f"{key:34} {value:12,.6g}")
    table = [projected(figures, options, workers) for workers in WORKERS]
    load = f"{options.paths:.3g} paths and a fit of {options.fit_seconds:g} s each"
    print(f"\n{options.library} materials, {load}:")
    for row in table:
        print(
            f"{row['workers']:5} workers: {clock(row['seconds']):>10}, "
            f"{row['worker hours']:8,.1f} worker hours, "
            f"efficiency {row['efficiency']:.0%}, limited by: {row['limited by']}"
        )
    print(json.dumps({**figures, "projection": table, "thresholds": THRESHOLDS}))
    return int(figures["overhead of one-second tasks"] > THRESHOLDS["overhead of one-second tasks"])


if __name__ == "__main__":
    sys.exit(main())
