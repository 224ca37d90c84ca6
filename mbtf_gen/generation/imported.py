"""Data sets of measured BTFs: one value per query, without a second estimate, geometry or known light."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.documents import finished_record, plan_digest
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.lattice import MAX_LEVEL, Lattice, level_of_sigma, sigma_of_level
from mbtf_core.data.schema import CONVENTIONS, ShardEntry, Split
from mbtf_core.data.shard_files import Arrays
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import data_sha256, file_sha256
from mbtf_core.files.folders import owned
from mbtf_gen.config.exchange import ImportConfig
from mbtf_gen.config.generator import count_queries
from mbtf_gen.generation.folder import claim_folder
from mbtf_gen.generation.manifest import Summary, finish, new_manifest
from mbtf_gen.generation.shard_record import store_shard
from mbtf_gen.measured.hdf5 import NeumipQueries
from mbtf_gen.measured.interface import MeasuredBtf
from mbtf_gen.measured.kinds import open_measured
from mbtf_gen.measured.ubo2003 import SUFFIXES
from mbtf_gen.planning.job import shard_entries
from mbtf_gen.sampling.rng import Purpose, numpy_generator

I64 = NDArray[np.int64]

# Bytes of a query: its arrays of float32 numbers.
MEASURED = ("u", "sigma", "omega_i", "omega_o", "value_a")
MEASURED_BYTES = 48
# What differs from rendered data.
MEANINGS = {
    "sigma": "half the width of a texel, or as the file states",
    "value_a": "the only value of the query (linear Rec.709 RGB)",
}
MEASURED_CONVENTIONS = {
    "heights": "unknown",
    "light": "as measured; its width is unknown",
    "value": "as measured, converted to radiance in 1/sr leaving towards omega_o per irradiance on the "
    "reference plane; no cosine, no clamp, no log; a Lambert plane gives albedo/pi",
    "halves": "value_a is the only value of a query; its noise is unknown",
    "holes": "unknown",
}
# Share of the pairs of light and view whose values are test queries alone.
TEST_PAIRS = 0.05
# Queries of a list that are read at once.
_BLOCK = 1 << 22


class Import(ABC):
    """A measured BTF that becomes a data set.

    Attributes
    ----------
    path : its file or folder
    config : options
    inputs : role → SHA-256 of the files
    lattice : texel grids, the finest at least as fine as the images
    divides_by_cosine : whether stored values include the cosine of the light
    facts : the manifest's key ``measured``
    notes : what is left out, in words
    negative : queries with a negative value among those that this run has written
    """

    lattice: Lattice
    facts: dict[str, Any]
    notes: list[str]
    negative = 0

    def __init__(self, path: Path, config: ImportConfig, source: object, cosine: bool | None) -> None:
        self.path, self.config, self.format = path, config, type(source).__name__
        self.inputs = {"measured": _digest(path)}
        included = {"auto": cosine, "included": True, "excluded": False}[config.cosine]
        if included is None:
            hint = "state it: --cosine included, or --cosine excluded"
            raise InputError("does not say whether values include the cosine", where=path, hint=hint)
        self.divides_by_cosine = included

    @staticmethod
    def prepare(path: Path, config: ImportConfig) -> Import:
        """Open a file or a folder; an InputError if it is no measured BTF of a known format, is damaged, or
        has no usable values."""
        source: Any = open_measured(path)
        kind = ImportOfImages if hasattr(source, "light") else ImportOfList
        return kind(path, config, source)

    @cached_property
    def config_hash(self) -> str:
        """Hash of everything that determines the data."""
        return self.config.hash(self.inputs)

    @abstractmethod
    def count(self, split: Split) -> int:
        """Queries of a split, at most those of the file."""

    @abstractmethod
    def shards(self, finished: Callable[[ShardEntry], bool]) -> Iterator[tuple[ShardEntry, Arrays | None]]:
        """Shards and their arrays, which may be left out of a finished shard."""

    def requested(self, split: Split) -> int:
        """Queries of a split that the configuration requests."""
        queries = self.config.queries
        return count_queries(queries.train if split == "train" else queries.test, self.lattice.texels())

    def entries(self, split: Split) -> list[ShardEntry]:
        """Shards of a split."""
        output = self.config.output
        return shard_entries(split, self.count(split), output.shard_queries, output.format)

    def manifest(self) -> dict[str, Any]:
        """Manifest of the data set without shards."""
        entries = [*self.entries("train"), *self.entries("test")]
        measured = {"format": self.format, "file": self.path.name, "light_width": None, **self.facts}
        return new_manifest(
            self,
            arrays=dict.fromkeys(MEASURED, "") | MEANINGS,
            splits={split: {"queries": self.count(split)} for split in ("train", "test")},
            entries=entries,
            measured={**measured, "divided_by_cosine": self.divides_by_cosine},
            conventions=CONVENTIONS | MEASURED_CONVENTIONS,
            estimates=1,
            geometry=None,
            effects=None,
            allocation=None,
            highlights=None,
        )


class ImportOfImages(Import):
    """Images under many pairs of light and view. Each query is a random texel under a random pair; test
    queries have pairs of their own."""

    def __init__(self, path: Path, config: ImportConfig, source: MeasuredBtf) -> None:
        super().__init__(path, config, source, source.cosine)
        self.source = source
        lowest = np.minimum(source.light[:, 2], source.view[:, 2])
        kept = np.flatnonzero(lowest >= config.queries.min_cos)
        if len(kept) == 0:
            what, hint = "has no pair of light and view above --min-cos", "lower it: --min-cos 0.05"
            raise InputError(what, where=path, hint=hint)
        kept = numpy_generator(config.seed, "test", 0, Purpose.CHOICE).permutation(kept)
        tested = max(1, round(TEST_PAIRS * len(kept))) if len(kept) > 1 else 0
        self.pairs: dict[Split, I64] = {"train": np.sort(kept[tested:]), "test": np.sort(kept[:tested])}
        self.lattice = Lattice((source.columns - 1).bit_length(), source.rows / source.columns)
        total = len(source.light) + source.left_out
        self.facts = {
            "left_out": total - len(kept),
            "images": [source.rows, source.columns],
            "pairs": total,
            "test_pairs": tested,
        }
        self.notes = [f"{total - len(kept)} of {total} pairs of light and view are left out: too low"]

    def count(self, split: Split) -> int:
        return min(self.requested(split), self.source.rows * self.source.columns * len(self.pairs[split]))

    def shards(self, finished: Callable[[ShardEntry], bool]) -> Iterator[tuple[ShardEntry, Arrays | None]]:
        source = self.source
        factor = np.full(len(source.light), self.config.scale, np.float32)
        if self.divides_by_cosine:
            factor /= source.light[:, 2]
        for split, pairs in self.pairs.items():
            entries = self.entries(split)
            size = max(1, source.at_once // self.config.output.shard_queries)
            for group in (entries[first : first + size] for first in range(0, len(entries), size)):
                if all(finished(entry) for entry in group):
                    yield from ((entry, None) for entry in group)
                    continue
                drawn = [self._draw(entry, pairs) for entry in group]
                # Images are decoded once for all shards of the group.
                pair, texel = (np.concatenate(parts) for parts in zip(*drawn, strict=True))
                value = source.values(pair, texel) * factor[pair, None]
                j, i = np.divmod(texel, source.columns)
                u = np.stack([(i + 0.5) / source.columns, 1.0 - (j + 0.5) / source.rows], axis=-1)
                arrays = {
                    "u": u.astype(np.float32),
                    "sigma": np.full(len(u), 0.5 / source.columns, np.float32),
                    "omega_i": source.light[pair],
                    "omega_o": source.view[pair],
                    "value_a": value,
                }
                yield from _cut(group, arrays)

    def _draw(self, entry: ShardEntry, pairs: I64) -> tuple[I64, I64]:
        """Random pairs and texels of a shard's queries."""
        random = numpy_generator(self.config.seed, entry.split, entry.index, Purpose.QUERIES)
        texels = self.source.rows * self.source.columns
        return pairs[random.integers(len(pairs), size=entry.rows)], random.integers(texels, size=entry.rows)


class ImportOfList(Import):
    """A list of queries. Those that are too low or have the footprint of no level are left out."""

    def __init__(self, path: Path, config: ImportConfig, source: NeumipQueries) -> None:
        # Lists are of NeuMIP, which divides by the cosine.
        super().__init__(path, config, source, cosine=False)
        self.source = source
        self.usable, sigma = 0, 0.5
        for block, rows in self._blocks():
            self.usable += len(rows)
            sigma = min(sigma, float(block["sigma"][rows].min(initial=0.5)))
        if self.usable < 2:
            raise InputError(
                f"has {self.usable} usable queries of {source.count:,}",
                where=path,
                hint="lower --min-cos, or check that the file is complete",
            )
        # Rounding of a footprint must not add a level.
        finest = max(0, math.ceil(float(level_of_sigma(np.float64(sigma))) - 2e-3))
        self.lattice = Lattice(finest, 1.0)
        left_out = source.count - self.usable
        self.facts = {"left_out": left_out, "queries": source.count}
        why = "too low, NaN, or of a footprint that is no level's"
        self.notes = [f"{left_out} of {source.count} queries are left out: {why}"] if left_out else []

    def count(self, split: Split) -> int:
        test = min(self.requested("test"), self.usable // 2)
        return test if split == "test" else min(self.requested("train"), self.usable - test)

    def shards(self, finished: Callable[[ShardEntry], bool]) -> Iterator[tuple[ShardEntry, Arrays | None]]:
        """Shards and their arrays, in random order within blocks of the file. Every block gives its share of
        the test queries and of the training queries."""
        test, train = self.count("test"), self.count("train")
        left: Arrays = {}
        kept: list[Arrays] = []
        waiting = self.entries("train")
        read = 0
        for number, (block, usable) in enumerate(self._blocks()):
            found: Arrays = {name: block[name] for name in MEASURED[:-1]}
            found["value_a"] = block["value"] * np.float32(self.config.scale)
            if self.divides_by_cosine:
                found["value_a"] /= found["omega_i"][:, 2:]
            # Counts are differences of cumulative ones, so that their sums are exact.
            ends = (read, read + len(usable))
            tested = [n * test // self.usable for n in ends]
            trained = [(n - t) * train // (self.usable - test) for n, t in zip(ends, tested, strict=True)]
            read = ends[1]
            rows = numpy_generator(self.config.seed, "train", number, Purpose.QUERIES).permutation(usable)
            count = tested[1] - tested[0]
            kept.append({name: a[rows[:count]] for name, a in found.items()})
            rows = rows[count : count + trained[1] - trained[0]]
            parts = {name: a[rows] for name, a in found.items()}
            left = {n: np.concatenate([left[n], a]) for n, a in parts.items()} if left else parts
            full, begin = [], 0
            while waiting and len(left["sigma"]) - begin >= waiting[0].rows:
                begin += waiting[0].rows
                full.append(waiting.pop(0))
            yield from _cut(full, left)
            left = {name: a[begin:] for name, a in left.items()}
        yield from _cut(
            self.entries("test"), {n: np.concatenate([part[n] for part in kept]) for n in MEASURED}
        )

    def _blocks(self) -> Iterator[tuple[Arrays, I64]]:
        """The queries, block by block, and the rows of the usable ones."""
        least, most = (float(sigma_of_level(level)) for level in (MAX_LEVEL, 0))
        for start in range(0, self.source.count, _BLOCK):
            block = self.source.read(start, min(start + _BLOCK, self.source.count))
            lowest = np.minimum(block["omega_i"][:, 2], block["omega_o"][:, 2])
            # Footprints of half precision are rounded.
            sigma = (block["sigma"] >= least * (1 - 1e-3)) & (block["sigma"] <= most * (1 + 1e-3))
            block["sigma"] = np.clip(block["sigma"], np.float32(least), np.float32(most))
            yield block, np.flatnonzero((lowest >= self.config.queries.min_cos) & sigma)


def import_measured(
    job: Import,
    folder: str | Path | DataFolder,
    *,
    overwrite: bool = False,
    progress: Callable[[int], None] | None = None,
) -> Summary:
    """Write a measured BTF as a data set, or finish an unfinished one; errors as of
    :func:`~mbtf_gen.generation.run.generate`. `progress` is called with the number of queries written."""
    start = time.perf_counter()
    folder = DataFolder.open(folder)
    with owned(folder.workspace):
        plan, written = plan_digest(claim_folder(job, folder, job.manifest, overwrite)), 0

        def finished(entry: ShardEntry) -> bool:
            return finished_record(folder, entry, job.config_hash) is not None

        for entry, arrays in job.shards(finished):
            if arrays is not None and not finished(entry):
                store_shard(folder, entry, arrays, job.config_hash, plan, job.config.seed)
                job.negative += int((arrays["value_a"] < 0.0).any(axis=-1).sum())
            written += entry.rows
            if progress is not None:
                progress(written)
        return finish(folder, seconds=time.perf_counter() - start)


def _cut(entries: Iterable[ShardEntry], arrays: Arrays) -> Iterator[tuple[ShardEntry, Arrays]]:
    """Shards and their rows of the arrays, one after the other."""
    begin = 0
    for entry in entries:
        yield entry, {name: a[begin : begin + entry.rows] for name, a in arrays.items()}
        begin += entry.rows


def _digest(path: Path) -> str:
    """SHA-256 of a file, or of the names and files of a folder's images."""
    if path.is_file():
        return file_sha256(path)
    files = sorted(p for p in path.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file())
    return data_sha256({p.relative_to(path).as_posix(): file_sha256(p) for p in files})
