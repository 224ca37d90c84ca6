"""What fitting from an object store costs: steps per second with a warm cache, beside a local data set.

    python benchmarks/object_stores.py [--queries N] [--rounds N] [--seconds S]

Generates a data set in a folder and at a URL of an S3 server on this machine, which must give equal shards.
Then fits of both, and of a copy of the folder, take turns, with the training queries in memory and streamed
from disk. Each ratio is that of the fastest rounds: other processes only slow a round down. The ratio of the
copy to its original says how far the others can be trusted; processor time per step varies less. The last
line is a JSON object.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from mbtf_core.data.store import ObjectStore
from mbtf_fit.config import FitConfig
from mbtf_fit.data.loader import load_training, open_data
from mbtf_fit.models.registry import MODELS
from mbtf_fit.training.device import keep_freed_memory
from mbtf_fit.training.fit import prepare_trainer
from mbtf_fit.training.trainer import Trainer
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation.run import generate

ASSETS = Path(__file__).parents[1] / "assets"
URL = "s3://bucket/data"
THRESHOLDS = {"speed from the store over local speed at least": 0.9}


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
    data = open_data(folder, MODELS[config.model].layout, config.model, config.data.cache)
    partition = load_training(data, config.held_out, config.seed, config.data.memory)
    seconds = time.perf_counter() - began
    return prepare_trainer(config, data, partition, torch.device("cpu")), seconds


def steps_per_second(trainer: Trainer, seconds: float) -> tuple[float, float]:
    """Of wall time, and of processor time."""
    step, began, busy = trainer.progress.step, time.perf_counter(), time.process_time()
    trainer.train(seconds)
    steps = trainer.progress.step - step
    return steps / (time.perf_counter() - began), steps / (time.process_time() - busy)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--queries", default="400/texel")
    parser.add_argument("--rounds", type=int, default=80)
    parser.add_argument("--seconds", type=float, default=0.25)
    options = parser.parse_args()
    keep_freed_memory()
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        server = serve(Path(name) / "cache")
        queries = {"train": options.queries, "test": "4096", "spp": 4, "test_spp": 8, "resolution": 64}
        config = GeneratorConfig.model_validate({"material": str(ASSETS / "cliff_rock"), "queries": queries})
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
    print(json.dumps({**figures, "thresholds": THRESHOLDS}))
    return int(min(v for k, v in figures.items() if k.endswith("/s, store over local")) < 0.9)


if __name__ == "__main__":
    sys.exit(main())
