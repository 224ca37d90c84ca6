"""Time and peak memory of importing 10⁸ values of a measured BTF.

    python benchmarks/import_memory.py [--values 100000000] [--folder FOLDER]

Writes a capture of 128 × 128 texels and 6561 pairs of light and view (1.3 GB) of random values, imports it
in a process of its own, and removes both.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from mbtf_gen.measured.neural_btf_hdf5 import write_neural_btf
from mbtf_gen.sampling.slice_directions import direction_pairs, slice_directions

SIDE = 128
# Largest peak in GiB.
THRESHOLD = 4.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--values", type=int, default=100_000_000)
    parser.add_argument("--folder", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=arguments.folder) as temporary:
        folder = Path(temporary)
        light, view = direction_pairs(slice_directions("spiral", 81, 0.2))
        random = np.random.default_rng(0)
        images = (random.random((SIDE, SIDE, 3), np.float32) for _ in light)
        write_neural_btf(folder / "capture.hdf5", light, view, images)
        command = [sys.executable, "-m", "mbtf_gen", "import", "capture.hdf5", "--cosine", "excluded"]
        start = time.perf_counter()
        subprocess.run([*command, "--queries", str(arguments.values), "-o", "shards"], cwd=folder, check=True)
        seconds = time.perf_counter() - start
        peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
    print(f"{arguments.values} values: {seconds:.0f} s, {peak:.2f} GiB at most")
    print(json.dumps({"values": arguments.values, "seconds": seconds, "gib": peak, "threshold": THRESHOLD}))
    return int(peak > THRESHOLD)


if __name__ == "__main__":
    sys.exit(main())
