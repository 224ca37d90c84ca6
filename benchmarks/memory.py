"""Memory and start of the generator on a 1024² height map: does either grow with the number of queries?

    python benchmarks/memory.py [--resolution 1024] [--queries 131072 524288]

Data sets of different numbers of queries are made by the command line in processes of their own, 16 paths
per query, from a rough relief with color and roughness at the same resolution. Read off are the process's
peak resident memory and the time from its start to its first finished shard, after a run that compiles the
kernels (they are kept on disk). The last line is one JSON object with the figures and the bars they are held
to; exit code 1 where one is missed.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

MEMORY_BAR_GIB = 2.0
START_BAR_SECONDS = 10.0
SHARD_QUERIES = 65536


def relief(resolution: int) -> np.ndarray:
    """Periodic random heights (resolution, resolution) in [0, 1]."""
    rng = np.random.default_rng(0)
    frequency = np.fft.fftfreq(resolution, 1.0 / resolution)
    radius = np.hypot(frequency[:, None], frequency[None, :])
    h = np.fft.ifft2(np.exp(2j * np.pi * rng.random(radius.shape)) / np.maximum(radius, 2.0) ** 2).real
    return (h - h.min()) / np.ptp(h)


def make_material(folder: Path, resolution: int) -> None:
    """A folder of maps."""
    from PIL import Image

    h = relief(resolution)
    np.save(folder / "height.npy", h.astype(np.float32))
    byte = (255 * h).astype(np.uint8)
    Image.fromarray(np.stack([byte, byte, 255 - byte], axis=-1)).save(folder / "base_color.png")
    Image.fromarray(64 + byte // 2).save(folder / "roughness.png")


def measure(material: Path, resolution: int, queries: int, out: Path) -> tuple[float, float, float]:
    """(peak memory in GiB, seconds to the first shard, seconds in all) of one run."""
    start = time.perf_counter()
    command = [sys.executable, "-m", "mbtf_gen", str(material), "--queries", str(queries), "-o", str(out)]
    # Light is always scattered, so that no plan leaves the second kernel out.
    command += ["--height-scale", "0.1", "--mesh", str(resolution), "--effects", "all", "--spp", "16"]
    command += ["--set", "queries.test=1024", "--set", f"output.shard_queries={SHARD_QUERIES}"]
    quiet = os.open(os.devnull, os.O_WRONLY)
    child = os.posix_spawn(command[0], command, os.environ, file_actions=[(os.POSIX_SPAWN_DUP2, quiet, 1)])
    os.close(quiet)
    first, status, used = float("nan"), 0, None
    while used is None:
        done, status, usage = os.wait4(child, os.WNOHANG)
        used = usage if done else None
        if np.isnan(first) and (out / "train-00000.json").exists():
            first = time.perf_counter() - start
        time.sleep(0.01)
    if status:
        raise SystemExit(f"the generator failed: {' '.join(command)}")
    return used.ru_maxrss / 2**20, first, time.perf_counter() - start


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--resolution", type=int, default=1024)
    parser.add_argument("--queries", type=int, nargs="+", default=[1 << 17, 1 << 19])
    arguments = parser.parse_args()
    rows = {}
    with tempfile.TemporaryDirectory() as folder:
        material = Path(folder) / "material"
        material.mkdir()
        make_material(material, arguments.resolution)
        measure(material, arguments.resolution, 4096, Path(folder) / "warm")
        for queries in arguments.queries:
            peak, first, seconds = measure(
                material, arguments.resolution, queries, Path(folder) / str(queries)
            )
            print(
                f"{queries:9d} queries: peak {peak:.2f} GiB, first shard after {first:.1f} of {seconds:.1f} s"
            )
            rows[str(queries)] = {
                "peak_gib": round(peak, 3),
                "first_shard_seconds": round(first, 2),
                "seconds": round(seconds, 2),
            }
    peak = max(row["peak_gib"] for row in rows.values())
    first = max(row["first_shard_seconds"] for row in rows.values())
    met = peak < MEMORY_BAR_GIB and first < START_BAR_SECONDS
    bars = {"peak_gib": MEMORY_BAR_GIB, "first_shard_seconds": START_BAR_SECONDS}
    print(json.dumps({"figures": rows, "bars": bars, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
