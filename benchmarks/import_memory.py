"""Time and peak memory of importing 10⁸ values of a measured BTF.

    python benchmarks/import_memory.py [--format ubo2014] [--values 100000000] [--folder FOLDER]

Writes a file of random values, imports it in a process of its own, and removes both. The formats are

- neuralbtf: images of 128 × 128 texels under 6561 pairs of light and view (1.3 GB);
- ubo2014: factors of 400 × 400 texels and 151 × 151 pairs, of 200 components in half precision (220 MB);
- neumip: a list of as many queries as are imported, 40 bytes each.
"""

from __future__ import annotations

import argparse
import json
import resource
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mbtf_gen.measured.neumip_hdf5 import write_neumip
from mbtf_gen.measured.neural_btf_hdf5 import write_neural_btf
from mbtf_gen.sampling.slice_directions import direction_pairs, slice_directions

SIDE = 128
# Texels across, directions, and components of a BTF of the University of Bonn.
TEXELS, DIRECTIONS, COMPONENTS = 400, 151, 200
# Largest peak in GiB.
THRESHOLD = 4.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--format", choices=tuple(WRITERS), default="neuralbtf")
    parser.add_argument("--values", type=int, default=100_000_000)
    parser.add_argument("--folder", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=arguments.folder) as temporary:
        folder = Path(temporary)
        WRITERS[arguments.format](folder / "measured", arguments.values)
        command = [sys.executable, "-m", "mbtf_gen", "import", "measured", "--cosine", "excluded"]
        start = time.perf_counter()
        subprocess.run([*command, "--queries", str(arguments.values), "-o", "shards"], cwd=folder, check=True)
        seconds = time.perf_counter() - start
        peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
    print(f"{arguments.values} values: {seconds:.0f} s, {peak:.2f} GiB at most")
    figures = {"format": arguments.format, "values": arguments.values, "seconds": seconds, "gib": peak}
    print(json.dumps({**figures, "threshold": THRESHOLD}))
    return int(peak > THRESHOLD)


def write_images(path: Path, values: int) -> None:
    """A capture of NeuralBTF."""
    light, view = direction_pairs(slice_directions("spiral", 81, 0.2))
    random = np.random.default_rng(0)
    write_neural_btf(path, light, view, (random.random((SIDE, SIDE, 3), np.float32) for _ in light))


def write_factors(path: Path, values: int) -> None:
    """A BTF of the University of Bonn (DFMF), in RGB."""
    omega = slice_directions("spiral", DIRECTIONS, 0.2).astype(np.float64)
    angles = np.stack([np.arccos(omega[:, 2]), np.arctan2(omega[:, 1], omega[:, 0])], axis=-1).astype("<f4")
    random = np.random.default_rng(0)
    with path.open("wb") as file:
        file.write(
            b"!DFMF08FCR" + struct.pack("<II", 8 + 256, 1) + bytes(240) + struct.pack("<4f", *[1.0] * 4)
        )
        file.write(struct.pack("<I", DIRECTIONS))
        for view in angles:
            file.write(view.tobytes() + struct.pack("<I", DIRECTIONS) + angles.tobytes())
        file.write(struct.pack("<IIIIi", TEXELS, TEXELS, 0, COMPONENTS, 0) + bytes(4 * 12))
        pairs, texels = DIRECTIONS**2, TEXELS**2
        for _ in range(3):
            file.write(struct.pack("<BIII", 2, COMPONENTS, pairs, texels) + bytes(2 * COMPONENTS))
            for rows in (pairs, texels):
                file.write(random.random((rows, COMPONENTS), np.float32).astype("<f2").tobytes())


def write_queries(path: Path, values: int) -> None:
    """A data set of NeuMIP: `values` queries, and the test queries."""
    random = np.random.default_rng(0)
    omega = slice_directions("spiral", 4096, 0.2)
    image = 512**2

    def batches() -> Iterator[dict[str, NDArray[np.float32]]]:
        for _ in range(-(-(values + 8192) // image)):
            yield {
                "u": random.random((image, 2), np.float32),
                "sigma": np.full(image, 0.5 / 512, np.float32),
                "omega_i": omega[random.integers(4096, size=image)],
                "omega_o": omega[random.integers(4096, size=image)],
                "value": random.random((image, 3), np.float32),
            }

    write_neumip(path, batches(), 512)


WRITERS = {"neuralbtf": write_images, "ubo2014": write_factors, "neumip": write_queries}

if __name__ == "__main__":
    sys.exit(main())
