"""What storing a data set costs: writing beside rendering, and checking beside plain reading.

    python benchmarks/storage.py [--material PATH] [--queries N] [--spp N]

Makes a data set, and says which part of its time rendering waited for the writer, and which part of the
processor writing and digesting took beside it. Then ``verify``, a plain read and plain digests of the same
files take turns; the median of five rounds each. The last line is a JSON object.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

from mbtf_core.data.verify import verify
from mbtf_core.files.digest import file_sha256
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation.run import generate

ASSETS = Path(__file__).parents[1] / "assets"
ROUNDS = 5
BARS = {"writing and waiting at most": 0.05, "verify over digest at least": 0.8}


def plainly(paths: list[Path]) -> None:
    for path in paths:
        with path.open("rb", buffering=0) as stream:
            buffer = bytearray(1 << 20)
            while stream.readinto(buffer):
                pass


def digested(paths: list[Path]) -> None:
    for path in paths:
        file_sha256(path)


def intact(folder: Path) -> None:
    assert verify(folder) == []


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--material", default=str(ASSETS / "turtle_shell"))
    parser.add_argument("--queries", type=int, default=5_000_000)
    parser.add_argument("--spp", type=int, default=4)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "shards"
        config = GeneratorConfig.model_validate(
            {
                "material": options.material,
                "queries": {"train": str(options.queries), "test": "1024", "spp": options.spp, "test_spp": 8},
            }
        )
        summary = generate(config, folder)
        paths = sorted(folder.glob("*.npz"))
        size = sum(path.stat().st_size for path in paths) / 1e6
        ways: dict[str, Callable[[], Any]] = {
            "verify": lambda: intact(folder),
            "plain read": lambda: plainly(paths),
            "sha256, one thread": lambda: digested(paths),
        }
        times: dict[str, list[float]] = {way: [] for way in ways}
        for _ in range(ROUNDS):
            for way, run in ways.items():
                start = time.perf_counter()
                run()
                times[way].append(time.perf_counter() - start)
    rates = {f"{way} MB/s": round(size / median(seconds), 1) for way, seconds in times.items()}
    verified = round(rates["verify MB/s"] / rates["sha256, one thread MB/s"], 3)
    writing = round(summary.writing_seconds / summary.seconds / (os.cpu_count() or 1), 4)
    waiting = round(summary.waiting_seconds / summary.seconds, 4)
    figures = {
        "MB": round(size, 1),
        "seconds": summary.seconds,
        "M paths/s": round(summary.paths_per_second / 1e6, 3),
        "writing share": writing,
        "waiting share": waiting,
        **rates,
        "verify over digest": verified,
        "bars": BARS,
    }
    print(json.dumps(figures))
    return int(writing + waiting > 0.05 or verified < 0.8)


if __name__ == "__main__":
    sys.exit(main())
