"""What storage and workers cost: shards on disk, fits from an object store, a cluster of workers.

    python benchmarks/store_and_cluster.py disk [--material PATH] [--queries N]
    python benchmarks/store_and_cluster.py store [--rounds N] [--seconds S]
    python benchmarks/store_and_cluster.py cluster [--workers 2] [--tasks 60] [--empty 2000]

``disk``: the time of writing over that of a run; then ``verify``, a plain read and plain digests of the same
files in turns.

``store``: steps per second of fits from an S3 server on this machine with a warm cache, over those from a
folder, with the queries in memory and streamed. Shards of both must be equal. Ratios are those of the fastest
rounds; the ratio of a copy of the folder to its original states how far they can be trusted.

``cluster``: start of local Dask workers, time per empty task, overhead of one-second tasks, a data set by one
process and by the workers.

The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import math
import os
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from common import ASSETS, alternate, finish, parser_of, start, timed

from mbtf_core.data.shard_files import row_bytes, write_shard
from mbtf_core.data.store import ObjectStore
from mbtf_core.data.verify import verify
from mbtf_core.files.atomic import file_sha256
from mbtf_core.run.cluster import open_runner
from mbtf_core.run.runner import Runner
from mbtf_core.run.task import Item, TaskFunction
from mbtf_core.units import clock
from mbtf_fit.config import FitConfig
from mbtf_fit.data.loader import load_training
from mbtf_fit.training.loop import TrainingLoop, keep_freed_memory
from mbtf_fit.training.suitable_data import open_data
from mbtf_fit.training.trainer import Trainer, prepare_trainer
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation.run import generate

URL = "s3://bucket/data"
# Paths per query and queries per shard: the defaults.
SPP, SHARD_QUERIES = 4, 1 << 18
DISK = {"writing at most": 0.05, "verify over digest at least": 0.8}
STORE = {"speed from the store over that from the folder at least": 0.9}
CLUSTER = {"overhead of one-second tasks at most": 0.05}
ROUNDS = 5


def config_of(material: object, train: object, resolution: int | None = None) -> GeneratorConfig:
    """A small data set of the default paths per query."""
    queries = {"train": str(train), "test": "1024", "spp": SPP, "test_spp": 8, "resolution": resolution}
    return GeneratorConfig.model_validate({"material": str(material), "queries": queries})


def read_plainly(path: Path) -> int:
    """Number of bytes of a file, read without interpreting them."""
    size = 0
    with path.open("rb", buffering=0) as stream:
        buffer = bytearray(1 << 20)
        while count := stream.readinto(buffer):
            size += count
    return size


def measure_disk(options: argparse.Namespace) -> int:
    """Writing beside rendering, and checking beside plain reading."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "shards"
        summary = generate(config_of(options.material, options.queries), folder)
        paths = sorted(folder.glob("*.npz"))
        size = sum(path.stat().st_size for path in paths) / 1e6
        writing = round(size / writing_rate(folder.parent / "writing") / summary.seconds, 4)
        ways: dict[str, Callable[[int], Any]] = {
            "verify": lambda _: verify(folder),
            "plain read": lambda _: [read_plainly(path) for path in paths],
            "sha256, one thread": lambda _: [file_sha256(path) for path in paths],
        }
        times = alternate(ways, ROUNDS)
    rates = {f"{way} MB/s": round(size / median(seconds), 1) for way, seconds in times.items()}
    verified = round(rates["verify MB/s"] / rates["sha256, one thread MB/s"], 3)
    figures = {"MB": round(size, 1), "seconds": summary.seconds, "writing share": writing}
    figures |= {"verify over digest": verified, **rates}
    return finish(figures, DISK, writing <= 0.05 and verified >= 0.8)


def serve(cache: Path) -> Any:
    """Start a server with an empty bucket, and let this process find it."""
    import s3fs
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    names = ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY")
    os.environ |= {**dict.fromkeys(names, "test"), "AWS_ENDPOINT_URL": f"http://{host}:{port}"}
    os.environ |= {"AWS_DEFAULT_REGION": "us-east-1", "XDG_CACHE_HOME": str(cache)}
    s3fs.S3FileSystem().mkdir("bucket")
    return server


def started(folder: str, memory: str) -> tuple[Trainer, float]:
    """A trainer at its first step, and the seconds of loading."""
    config = FitConfig.model_validate({"data": {"memory": memory}, "training": {"time": "1h"}})
    began = time.perf_counter()
    data = open_data(folder, config.model, config.data.cache)
    partition = load_training(data, config.held_out, config.seed, config.data.memory)
    seconds = time.perf_counter() - began
    return prepare_trainer(config, data, partition, torch.device("cpu")), seconds


def steps_per_second(trainer: Trainer, seconds: float) -> tuple[float, float]:
    """Of wall time, and of processor time."""
    step, began, busy = trainer.progress.step, time.perf_counter(), time.process_time()
    TrainingLoop([trainer]).train(seconds)
    steps = trainer.progress.step - step
    return steps / (time.perf_counter() - began), steps / (time.process_time() - busy)


def measure_store(options: argparse.Namespace) -> int:
    """Fits from a store beside those from a folder."""
    keep_freed_memory()
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        server = serve(Path(name) / "cache")
        config = config_of(options.material, options.queries, 64)
        local = Path(name) / "local"
        for folder in (str(local), URL):
            summary = generate(config, folder)
            figures[f"seconds of generation, {'store' if folder == URL else 'local'}"] = summary.seconds
        copy = Path(shutil.copytree(local, Path(name) / "copy"))
        store = ObjectStore(URL)
        for path in sorted(local.glob("*.npz")):
            assert store.read(path.name) == path.read_bytes(), path.name
        figures["loading, cold cache"] = round(started(URL, "4GB")[1], 2)
        for memory, kind in (("4GB", "in memory"), ("1kB", "streamed")):
            places = {"local": str(local), "copy": str(copy), "store": URL}
            trainers = {place: started(folder, memory) for place, folder in places.items()}
            rates: dict[str, list[tuple[float, float]]] = {place: [] for place in trainers}
            for place, (trainer, loading) in trainers.items():
                figures[f"{kind}: loading, {place}"] = round(loading, 2)
                steps_per_second(trainer, 1.0)
            names = list(trainers)
            for number in range(options.rounds):
                # What follows what differs from round to round.
                for place in names[number % 3 :] + names[: number % 3]:
                    rates[place].append(steps_per_second(trainers[place][0], options.seconds))
            for index, unit in enumerate(("steps/s", "steps per processor second")):
                best = {place: max(rate[index] for rate in found) for place, found in rates.items()}
                figures |= {f"{kind}: {unit}, {place}": round(rate, 2) for place, rate in best.items()}
                for place in ("copy", "store"):
                    figures[f"{kind}: {unit}, {place} over local"] = round(best[place] / best["local"], 4)
        server.stop()
    slowest = min(v for k, v in figures.items() if k.endswith("/s, store over local"))
    return finish(figures, STORE, slowest >= 0.9)


def wait(seconds: float) -> None:
    """A task that only takes time; workers import it from this file."""
    time.sleep(seconds)


def run_tasks(runner: Runner, count: int, function: TaskFunction, arguments: dict[str, Any]) -> float:
    """Seconds of some equal tasks."""
    items = [Item(f"item-{i}", arguments) for i in range(count)]

    def run() -> None:
        for done in runner.map(function, items):
            assert not done.error, done.error

    return timed(run)


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


def measure_cluster(options: argparse.Namespace) -> int:
    """Overhead of workers."""
    figures: dict[str, float] = {}
    config = config_of(options.material, options.queries)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        began = time.perf_counter()
        # Workers import it from this file, which is the main module here.
        from store_and_cluster import wait as wait_on_worker

        with open_runner(f"local:{options.workers}", print) as runner:
            figures["seconds of a worker's start"] = round(time.perf_counter() - began, 2)
            empty = run_tasks(runner, options.empty, clock, {"seconds": 0.0})
            figures["seconds per empty task"] = round(empty / options.empty, 6)
            each = run_tasks(runner, options.tasks, wait_on_worker, {"seconds": 1.0})
            ideal = math.ceil(options.tasks / options.workers)
            figures["overhead of one-second tasks"] = round(each / ideal - 1.0, 4)
            clustered = timed(lambda: generate(config, folder / "cluster", runner=runner))
        plain = timed(lambda: generate(config, folder / "plain"))
        figures["data set by one process, s"] = round(plain, 2)
        figures["data set by the workers, s"] = round(clustered, 2)
    for key, value in figures.items():
        print(f"{key:34} {value:12,.6g}")
    met = figures["overhead of one-second tasks"] <= 0.05
    return finish(figures, CLUSTER, met)


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("part", choices=("disk", "store", "cluster"))
    parser.add_argument("--material", default=ASSETS / "turtle_shell")
    parser.add_argument("--queries", default=16 * SHARD_QUERIES)
    parser.add_argument("--rounds", type=int, default=80, help="of fits from the store")
    parser.add_argument("--seconds", type=float, default=0.25, help="of each fit in a round")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--tasks", type=int, default=60, help="one-second tasks")
    parser.add_argument("--empty", type=int, default=2000, help="empty tasks")
    options = parser.parse_args()
    measure = {"disk": measure_disk, "store": measure_store, "cluster": measure_cluster}
    return measure[options.part](options)


if __name__ == "__main__":
    start(main)
