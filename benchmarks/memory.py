"""Peak memory of the generator and of imports: neither may grow with the number of queries.

    python benchmarks/memory.py [generate] [--resolution 1024] [--queries 131072 524288]
    python benchmarks/memory.py import [--format ubo2014] [--values 100000000] [--folder FOLDER]

``generate`` makes data sets of different sizes from random heights with maps of color and roughness, each in
a process of its own, after a run that compiles the kernels. It measures the peak resident memory and the
time from the start to the first shard.

``import`` writes a file of random values, imports it, and removes both. Formats:

- ubo2014: factors of 400 × 400 texels and 151 × 151 pairs, of 200 components in half precision (220 MB);
- neumip: a list of as many queries as are imported, 40 bytes each.

The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import resource
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

import h5py
import numpy as np
from common import finish, parser_of, start, timed, watched

from mbtf_gen.measured.hdf5 import CHANNELS, COLOR, LIGHT, PLACE, RADIUS, VIEW
from mbtf_gen.sampling.query_sampler import slice_directions

GENERATE = {"peak_gib": 2.0, "first_shard_seconds": 10.0}
IMPORT = {"peak_gib": 4.0}
SHARD_QUERIES = 65536
# Texels across, directions, and components of a BTF of the University of Bonn.
TEXELS, DIRECTIONS, COMPONENTS = 400, 151, 200


def random_heights(resolution: int) -> np.ndarray:
    """Periodic random heights (resolution, resolution) in [0, 1]."""
    rng = np.random.default_rng(0)
    frequency = np.fft.fftfreq(resolution, 1.0 / resolution)
    radius = np.hypot(frequency[:, None], frequency[None, :])
    h = np.fft.ifft2(np.exp(2j * np.pi * rng.random(radius.shape)) / np.maximum(radius, 2.0) ** 2).real
    return (h - h.min()) / np.ptp(h)


def make_material(folder: Path, resolution: int) -> None:
    """A folder of maps."""
    from PIL import Image

    h = random_heights(resolution)
    np.save(folder / "height.npy", h.astype(np.float32))
    byte = (255 * h).astype(np.uint8)
    Image.fromarray(np.stack([byte, byte, 255 - byte], axis=-1)).save(folder / "base_color.png")
    Image.fromarray(64 + byte // 2).save(folder / "roughness.png")


def generated(material: Path, resolution: int, queries: int, out: Path) -> tuple[float, float, float]:
    """(peak memory in GiB, seconds to the first shard, seconds in all) of one run."""
    command = [sys.executable, "-m", "mbtf_gen", str(material), "--queries", str(queries), "-o", str(out)]
    # Light is always scattered, so that no plan leaves the second kernel out.
    command += ["--height-scale", "0.1", "--mesh", str(resolution), "--effects", "all", "--spp", "16"]
    command += ["--set", "queries.test=1024", "--set", f"output.shard_queries={SHARD_QUERIES}"]
    return watched(command, out)


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
    shape = (-(-(values + 8192) // 512**2), 512, 512)
    with h5py.File(path, "w") as file:
        file.attrs["base_radius"] = 0.5 / 512
        stored = {
            name: file.create_dataset(name, (*shape, c), np.float32, chunks=(1, 512, 512, c))
            for name, c in CHANNELS.items()
        }
        for image in range(shape[0]):
            stored[PLACE][image] = 2 * random.random((512, 512, 2), np.float32) - 1
            stored[RADIUS][image] = 0.5 / 512
            for name in (LIGHT, VIEW):
                stored[name][image] = -omega[random.integers(4096, size=(512, 512)), :2]
            stored[COLOR][image] = random.random((512, 512, 3), np.float32)


WRITERS = {"ubo2014": write_factors, "neumip": write_queries}


def generate(arguments: argparse.Namespace) -> int:
    """Data sets of growing size."""
    rows = {}
    with tempfile.TemporaryDirectory() as name:
        folder, resolution = Path(name), arguments.resolution
        material = folder / "material"
        material.mkdir()
        make_material(material, resolution)
        generated(material, resolution, 4096, folder / "warm")
        for queries in arguments.queries:
            peak, first, seconds = generated(material, resolution, queries, folder / str(queries))
            print(f"{queries:9d} queries: {peak:.2f} GiB, first shard after {first:.1f} of {seconds:.1f} s")
            values = (round(peak, 3), round(first, 2), round(seconds, 2))
            rows[str(queries)] = dict(zip((*GENERATE, "seconds"), values, strict=True))
    met = all(row[name] < most for row in rows.values() for name, most in GENERATE.items())
    return finish(rows, GENERATE, met)


def import_values(arguments: argparse.Namespace) -> int:
    """One format of measured BTFs."""
    with tempfile.TemporaryDirectory(dir=arguments.folder) as temporary:
        folder = Path(temporary)
        WRITERS[arguments.format](folder / "measured", arguments.values)
        command = [sys.executable, "-m", "mbtf_gen", "import", "measured", "--cosine", "excluded"]
        command += ["--queries", str(arguments.values), "-o", "shards"]
        seconds = timed(lambda: subprocess.run(command, cwd=folder, check=True, stdout=sys.stderr))
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
    print(f"{arguments.values} values: {seconds:.0f} s, {peak:.2f} GiB at most")
    figures = {"format": arguments.format, "values": arguments.values, "seconds": seconds, "peak_gib": peak}
    return finish(figures, IMPORT, peak < IMPORT["peak_gib"])


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("part", nargs="?", choices=("generate", "import"), default="generate")
    parser.add_argument("--resolution", type=int, default=1024)
    parser.add_argument("--queries", type=int, nargs="+", default=[1 << 17, 1 << 19])
    parser.add_argument("--format", choices=tuple(WRITERS), default="ubo2014")
    parser.add_argument("--values", type=int, default=100_000_000)
    parser.add_argument("--folder", type=Path, help="for the files of an import; 6 GB")
    arguments = parser.parse_args()
    return generate(arguments) if arguments.part == "generate" else import_values(arguments)


if __name__ == "__main__":
    start(main)
