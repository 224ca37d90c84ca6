"""What an import of a measured BTF writes: its pairs of light and view, numbers of queries and shards."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TypeGuard, cast

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.lattice import MAX_LEVEL, Lattice, level_of_sigma, sigma_of_level
from mbtf_core.data.schema import SPLITS, ShardEntry, Split
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import data_sha256, file_sha256
from mbtf_gen.config.generator import count_queries
from mbtf_gen.config.measured import ImportConfig
from mbtf_gen.measured.interface import MeasuredBtf, MeasuredQueries, QueryBlock
from mbtf_gen.measured.open import open_measured
from mbtf_gen.measured.ubo2003 import SUFFIXES
from mbtf_gen.sampling.rng import Purpose, numpy_generator

# Share of the pairs of light and view whose values are test queries alone.
TEST_PAIRS = 0.05
# Queries of a list that are read at once.
_BLOCK = 1 << 22


def has_images(source: MeasuredBtf | MeasuredQueries) -> TypeGuard[MeasuredBtf]:
    """Whether a measured BTF consists of images, not of a list of queries."""
    return hasattr(source, "light")


@dataclass(frozen=True)
class Import:
    """A measured BTF that becomes a data set.

    Attributes
    ----------
    path : its file or folder
    config : options
    source : its reader
    digests : role → SHA-256 of the files
    usable : number of usable queries in a list; finest : level of its finest footprint among these
    """

    path: Path
    config: ImportConfig
    source: MeasuredBtf | MeasuredQueries
    digests: dict[str, str]
    usable: int = 0
    finest: int = 0

    @classmethod
    def prepare(cls, path: Path, config: ImportConfig) -> Import:
        """Open a file or a folder.

        Raises
        ------
        InputError : it is no measured BTF of a known format, or damaged
        """
        source, digests = open_measured(path), {"measured": _digest(path)}
        if not has_images(source):
            source = cast(MeasuredQueries, source)
            usable, sigma = _scan(source, config.queries.min_cos)
            if usable < 2:
                raise InputError(
                    f"has {usable} usable queries of {source.count:,}",
                    where=path,
                    hint="lower --min-cos, or check that the file is complete",
                )
            # Rounding of a footprint must not add a level.
            finest = max(0, math.ceil(float(level_of_sigma(np.float64(sigma))) - 2e-3))
            return cls(path, config, source, digests, usable, finest)
        found = cls(path, config, source, digests)
        if found.pairs is not None and len(found.pairs[0]) == 0:
            raise InputError(
                "has no pair of light and view above --min-cos", where=path, hint="lower it: --min-cos 0.05"
            )
        return found

    @property
    def config_hash(self) -> str:
        """Hash of everything that determines the data."""
        return self.config.hash(self.digests)

    @property
    def lattice(self) -> Lattice:
        """Texel grids, the finest at least as fine as the images."""
        source = self.source
        if has_images(source):
            return Lattice((source.columns - 1).bit_length(), source.rows / source.columns)
        return Lattice(self.finest, 1.0)

    @property
    def texels(self) -> int:
        """Texels of an image; of the finest level where there are no images."""
        source = self.source
        return source.rows * source.columns if has_images(source) else self.lattice.texels()

    @cached_property
    def pairs(self) -> tuple[NDArray[np.int64], NDArray[np.int64]] | None:
        """Numbers of the pairs of light and view for training and for testing; None for a list of queries."""
        if not has_images(self.source):
            return None
        lowest = np.minimum(self.source.light[:, 2], self.source.view[:, 2])
        kept = np.flatnonzero(lowest >= self.config.queries.min_cos)
        random = numpy_generator(self.config.seed, "test", 0, Purpose.CHOICE)
        kept = random.permutation(kept)
        count = max(1, round(TEST_PAIRS * len(kept))) if len(kept) > 1 else 0
        return np.sort(kept[count:]), np.sort(kept[:count])

    @property
    def left_out(self) -> int:
        """Pairs of light and view that are too low; queries of a list that are unusable."""
        source, pairs = self.source, self.pairs
        if has_images(source) and pairs is not None:
            return len(source.light) + source.left_out - sum(map(len, pairs))
        return cast(MeasuredQueries, source).count - self.usable

    @property
    def divides_by_cosine(self) -> bool:
        """Whether stored values include the cosine of the light; an InputError where nobody says."""
        # Lists are of NeuMIP, which divides by it.
        said = self.source.cosine if has_images(self.source) else False
        included = {"auto": said, "included": True, "excluded": False}[self.config.cosine]
        if included is None:
            hint = "state it: --cosine included, or --cosine excluded"
            raise InputError("does not say whether values include the cosine", where=self.path, hint=hint)
        return included

    def count(self, split: Split) -> int:
        """Queries of a split, at most those of the file."""
        queries = self.config.queries
        texels = self.lattice.texels()
        asked = count_queries(queries.train if split == "train" else queries.test, texels)
        if has_images(self.source):
            assert self.pairs is not None
            return min(asked, self.texels * len(self.pairs[SPLITS.index(split)]))
        test = min(count_queries(queries.test, texels), self.usable // 2)
        return test if split == "test" else min(asked, self.usable - test)

    def entries(self, split: Split) -> list[ShardEntry]:
        """Shards of a split."""
        size, total = self.config.output.shard_queries, self.count(split)
        names = (f"{split}-{k:05d}.{self.config.output.format}" for k in range(-(-total // size)))
        return [ShardEntry(split, k, n, min(size, total - k * size)) for k, n in enumerate(names)]


def usable_blocks(source: MeasuredQueries, min_cos: float) -> Iterator[tuple[QueryBlock, NDArray[np.int64]]]:
    """The queries of a list, block by block, and the rows of the usable ones: not too low, and with the
    footprint of one of the levels that data can have."""
    least, most = (float(sigma_of_level(level)) for level in (MAX_LEVEL, 0))
    for start in range(0, source.count, _BLOCK):
        block = source.read(start, min(start + _BLOCK, source.count))
        lowest = np.minimum(block["omega_i"][:, 2], block["omega_o"][:, 2])
        # Footprints of half precision are rounded.
        sigma = (block["sigma"] >= least * (1 - 1e-3)) & (block["sigma"] <= most * (1 + 1e-3))
        block["sigma"] = np.clip(block["sigma"], np.float32(least), np.float32(most))
        yield block, np.flatnonzero((lowest >= min_cos) & sigma)


def _scan(source: MeasuredQueries, min_cos: float) -> tuple[int, float]:
    """Number of usable queries, and their smallest footprint."""
    usable, sigma = 0, 0.5
    for block, rows in usable_blocks(source, min_cos):
        usable += len(rows)
        sigma = min(sigma, float(block["sigma"][rows].min(initial=0.5)))
    return usable, sigma


def _digest(path: Path) -> str:
    """SHA-256 of a file, or of the names and files of a folder's images."""
    if path.is_file():
        return file_sha256(path)
    files = sorted(p for p in path.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file())
    return data_sha256({p.relative_to(path).as_posix(): file_sha256(p) for p in files})
