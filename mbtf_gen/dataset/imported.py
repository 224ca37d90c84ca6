"""Data sets of measured BTFs: one value per query, without a second estimate, geometry or known light."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeGuard, cast

import numpy as np
from numpy.typing import NDArray

from mbtf_core.atomic import read_json, remove_file, write_checksummed, write_text
from mbtf_core.config_file import dump_yaml
from mbtf_core.digest import data_sha256, file_sha256
from mbtf_core.errors import InputError
from mbtf_core.folders import check_folder, make_folder, other_configuration, owned
from mbtf_core.lattice import Lattice, level_of_sigma, sigma_of_level
from mbtf_core.shard_schema import (
    ARRAYS,
    CONFIG_NAME,
    CONVENTIONS,
    FORMAT_NAME,
    LEADING_AXES,
    MANIFEST_NAME,
    SCHEMA_VERSION,
    SPLITS,
    ShardEntry,
    Split,
)
from mbtf_gen.config.generator import count_queries
from mbtf_gen.config.measured import ImportConfig
from mbtf_gen.dataset.folder import clear, read_manifest
from mbtf_gen.dataset.manifest import plan_digest, software_versions
from mbtf_gen.dataset.shard_io import Arrays, write_shard
from mbtf_gen.dataset.sidecar import finished_record, sidecar_of
from mbtf_gen.dataset.summary import Summary, finish
from mbtf_gen.measured.interface import MeasuredBtf, MeasuredQueries, Queries
from mbtf_gen.measured.open import open_measured
from mbtf_gen.sampling.rng import Purpose, numpy_generator

# Arrays of measured data.
MEASURED = ("u", "sigma", "omega_i", "omega_o", "value_a")
MEASURED_BYTES = 48
# What differs from rendered data.
MEASURED_MEANINGS = {
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
# Queries whose values are read at once: images of a folder are decoded once per so many.
_AT_ONCE = 1 << 24

Progress = Callable[[int], None]


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
            assert not hasattr(source, "light")
            usable, sigma = _scan(source, config.queries.min_cos)
            if usable < 2:
                raise InputError(
                    f"has {usable} usable queries of {source.count:,}",
                    where=path,
                    hint="lower --min-cos, or check that the file is complete",
                )
            # Rounding of a footprint must not add a level.
            finest = max(0, math.ceil(float(level_of_sigma(np.float64(sigma))) - 1e-3))
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

    @property
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
        """Pairs of light and view that are too low; queries of a list that are too low or not numbers."""
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

    @property
    def shards(self) -> list[ShardEntry]:
        """All shards."""
        return [entry for split in SPLITS for entry in self.entries(split)]


def _blocks(source: MeasuredQueries, min_cos: float) -> Iterator[tuple[Queries, NDArray[np.int64]]]:
    """The queries of a list, block by block, and the rows of those that are not too low."""
    for start in range(0, source.count, _AT_ONCE // 2):
        block = source.read(start, min(start + _AT_ONCE // 2, source.count))
        lowest = np.minimum(block["omega_i"][:, 2], block["omega_o"][:, 2])
        yield block, np.flatnonzero(lowest >= min_cos)


def _scan(source: MeasuredQueries, min_cos: float) -> tuple[int, float]:
    """Number of usable queries, and their smallest footprint."""
    usable, sigma = 0, 0.5
    for block, rows in _blocks(source, min_cos):
        usable += len(rows)
        sigma = min(sigma, float(block["sigma"][rows].min(initial=0.5)))
    return usable, sigma


def _digest(path: Path) -> str:
    """SHA-256 of a file, or of the names and files of a folder."""
    if path.is_file():
        return file_sha256(path)
    files = sorted(p for p in path.rglob("*") if p.is_file())
    return data_sha256({p.relative_to(path).as_posix(): file_sha256(p) for p in files})


def _manifest(job: Import) -> dict[str, Any]:
    config, lattice, source = job.config.model_dump(mode="json"), job.lattice, job.source
    conventions = CONVENTIONS | MEASURED_CONVENTIONS
    read: dict[str, Any] = {
        "format": type(source).__name__,
        "file": job.path.name,
        "left_out": job.left_out,
        "divided_by_cosine": job.divides_by_cosine,
        "light_width": None,
    }
    if has_images(source):
        assert job.pairs is not None
        read |= {
            "images": [source.rows, source.columns],
            "pairs": len(source.light) + source.left_out,
            "test_pairs": len(job.pairs[1]),
        }
    else:
        read["queries"] = cast(MeasuredQueries, source).count
    return {
        "format": FORMAT_NAME,
        "schema": SCHEMA_VERSION,
        "complete": False,
        "config_hash": job.config_hash,
        "config": config,
        "config_yaml": hashlib.sha256(dump_yaml(config).encode()).hexdigest(),
        "inputs": job.digests,
        "measured": read,
        "conventions": conventions,
        "tile": {"aspect": lattice.aspect},
        "levels": {
            "finest": lattice.finest,
            "shape": list(lattice.shape()),
            "sigma_finest": float(sigma_of_level(lattice.finest)),
        },
        "layout": "shuffled",
        "patch_size": None,
        "slice_size": None,
        "estimates": 1,
        "array_format": job.config.output.format,
        "arrays": {
            a.name: {
                "shape": [*LEADING_AXES["shuffled"], *a.trailing],
                "unit": a.unit,
                "meaning": MEASURED_MEANINGS.get(a.name, a.meaning),
            }
            for a in ARRAYS
            if a.name in MEASURED
        },
        "geometry": None,
        "effects": None,
        "allocation": None,
        "splits": {
            split: {
                "queries": job.count(split),
                "shards": [{"file": e.file, "rows": e.rows} for e in job.entries(split)],
            }
            for split in SPLITS
        },
        "software": software_versions(),
        "summary": None,
    }


def import_measured(
    job: Import, folder: Path, *, overwrite: bool = False, progress: Progress | None = None
) -> Summary:
    """Write a measured BTF as a data set, or finish an unfinished one.

    Parameters
    ----------
    job : Import
        The measured BTF and the options.
    folder : Path
        Output folder.
    overwrite : bool
        Replace the folder's data set.
    progress : callable, optional
        Called with the number of queries that are written.

    Returns
    -------
    Summary
        Of the data set.

    Raises
    ------
    InputError
        The file is damaged, or the folder contains something else.
    PartialError
        The folder cannot be written, or another process writes to it; the same command resumes.
    """
    start = time.perf_counter()
    manifest = _manifest(job)
    with owned(folder):
        if check_folder(folder, lambda path: (path / MANIFEST_NAME).exists(), "data set"):
            if overwrite:
                clear(folder)
            else:
                _check_same(folder, manifest)
        make_folder(folder)
        if not (folder / MANIFEST_NAME).exists():
            write_checksummed(folder / MANIFEST_NAME, manifest)
        write_text(folder / CONFIG_NAME, dump_yaml(manifest["config"]))
        plan, written = plan_digest(manifest), 0
        source = job.source
        parts = (
            _of_images(job, source, folder)
            if has_images(source)
            else _of_list(job, cast(MeasuredQueries, source))
        )
        for entry, arrays in parts:
            if arrays is not None and not finished_record(folder, entry, job.config_hash):
                _store(job, folder, plan, entry, arrays)
            written += entry.rows
            if progress is not None:
                progress(written)
        return finish(folder, seconds=time.perf_counter() - start)


def _check_same(folder: Path, manifest: dict[str, Any]) -> None:
    old = read_json(folder / MANIFEST_NAME)
    if old.get("config_hash") == manifest["config_hash"]:
        read_manifest(folder)
        return
    before, after = ({"inputs": m.get("inputs", {}), **(m.get("config") or {})} for m in (old, manifest))
    raise other_configuration(folder, "a data set", before, after)


def _of_images(job: Import, source: MeasuredBtf, folder: Path) -> Iterator[tuple[ShardEntry, Arrays | None]]:
    """Shards with their arrays; None where the shard is finished already."""
    assert job.pairs is not None
    factor = np.full(len(source.light), job.config.scale, np.float32)
    if job.divides_by_cosine:
        factor /= source.light[:, 2]
    for pairs, split in zip(job.pairs, SPLITS, strict=True):
        entries = job.entries(split)
        size = max(1, _AT_ONCE // job.config.output.shard_queries)
        for first in range(0, len(entries), size):
            group = entries[first : first + size]
            if all(finished_record(folder, entry, job.config_hash) for entry in group):
                yield from ((entry, None) for entry in group)
                continue
            drawn = [_draw(job, entry, pairs) for entry in group]
            pair, texel = (np.concatenate(parts) for parts in zip(*drawn, strict=True))
            value = source.values(pair, texel) * factor[pair, None]
            begin = 0
            for entry in group:
                rows = slice(begin, begin + entry.rows)
                begin += entry.rows
                j, i = np.divmod(texel[rows], source.columns)
                u = np.stack([(i + 0.5) / source.columns, 1.0 - (j + 0.5) / source.rows], axis=-1)
                yield (
                    entry,
                    {
                        "u": u.astype(np.float32),
                        "sigma": np.full(entry.rows, 0.5 / source.columns, np.float32),
                        "omega_i": source.light[pair[rows]],
                        "omega_o": source.view[pair[rows]],
                        "value_a": value[rows],
                    },
                )


def _draw(
    job: Import, entry: ShardEntry, pairs: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Random pairs and texels of a shard's queries."""
    random = numpy_generator(job.config.seed, entry.split, entry.index, Purpose.QUERIES)
    return pairs[random.integers(len(pairs), size=entry.rows)], random.integers(job.texels, size=entry.rows)


def _of_list(job: Import, source: MeasuredQueries) -> Iterator[tuple[ShardEntry, Arrays | None]]:
    """Shards and arrays, in random order within blocks of the file. Every block gives its share of the test
    queries and of the training queries."""
    test, train = job.count("test"), job.count("train")
    left: Arrays = {}
    kept: list[Arrays] = []
    waiting = iter(job.entries("train"))
    entry = next(waiting, None)
    read = 0
    for number, (block, usable) in enumerate(_blocks(source, job.config.queries.min_cos)):
        found: Arrays = {name: block[name] for name in MEASURED[:-1]}  # type: ignore[literal-required]
        found["value_a"] = block["value"] * np.float32(job.config.scale)
        if job.divides_by_cosine:
            found["value_a"] /= found["omega_i"][:, 2:]
        # Counts are differences of cumulative ones, so that their sums are exact.
        ends = (read, read + len(usable))
        tested = [n * test // job.usable for n in ends]
        trained = [(n - t) * train // (job.usable - test) for n, t in zip(ends, tested, strict=True)]
        read = ends[1]
        random = numpy_generator(job.config.seed, "train", number, Purpose.QUERIES)
        rows = random.permutation(usable)
        count = tested[1] - tested[0]
        kept.append({name: a[rows[:count]] for name, a in found.items()})
        rows = rows[count : count + trained[1] - trained[0]]
        parts = {name: a[rows] for name, a in found.items()}
        left = {n: np.concatenate([left[n], a]) for n, a in parts.items()} if left else parts
        begin = 0
        while entry is not None and len(left["sigma"]) - begin >= entry.rows:
            yield entry, {name: a[begin : begin + entry.rows] for name, a in left.items()}
            begin += entry.rows
            entry = next(waiting, None)
        left = {name: a[begin:] for name, a in left.items()}
    held = {name: np.concatenate([part[name] for part in kept]) for name in MEASURED}
    begin = 0
    for entry in job.entries("test"):
        yield entry, {name: a[begin : begin + entry.rows] for name, a in held.items()}
        begin += entry.rows


def _store(job: Import, folder: Path, plan: str, entry: ShardEntry, arrays: Arrays) -> None:
    """Write a shard and its sidecar."""
    path = folder / entry.file
    remove_file(sidecar_of(path))
    started = time.perf_counter()
    stored = write_shard(path, {name: arrays[name] for name in MEASURED})
    record = {
        "format": FORMAT_NAME,
        "schema": SCHEMA_VERSION,
        "config_hash": job.config_hash,
        "plan": plan,
        **{key: getattr(entry, key) for key in ("file", "split", "index", "rows")},
        **asdict(stored),
        "seed": {"root": job.config.seed, "split": entry.split, "shard": entry.index},
        "spp": None,
        "queries": entry.rows,
        "paths": 0,
        "seconds": round(time.perf_counter() - started, 4),
        "quarantined": {"nonfinite_samples": 0, "lost_rays": 0, "capped_rays": 0, "nonfinite_at": []},
        "target": None,
        "statistics": {
            "mean_value": arrays["value_a"].mean(axis=0, dtype=np.float64).tolist(),
            # Unknown: a query has a single value.
            "mean_variance": None,
        },
    }
    write_checksummed(sidecar_of(path), record)
