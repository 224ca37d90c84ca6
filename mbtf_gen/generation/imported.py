"""Data sets of measured BTFs: one value per query, without a second estimate, geometry or known light."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.data.documents import finished_record, plan_digest, read_manifest, sidecar, software_versions
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.lattice import sigma_of_level
from mbtf_core.data.schema import (
    ARRAYS,
    CONFIG_NAME,
    CONVENTIONS,
    FORMAT_NAME,
    LEADING_AXES,
    MANIFEST_NAME,
    SCHEMA_VERSION,
    SPLITS,
    ShardEntry,
)
from mbtf_core.data.shard_files import Arrays, write_shard
from mbtf_core.files.atomic import Stored, checksummed
from mbtf_core.files.folders import make_folder, owned
from mbtf_gen.generation.folder import holds_dataset, other_data_set
from mbtf_gen.generation.import_job import Import, has_images, usable_blocks
from mbtf_gen.generation.summary import Summary, finish
from mbtf_gen.measured.interface import MeasuredBtf, MeasuredQueries
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

Progress = Callable[[int], None]


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
    job: Import,
    folder: str | Path | DataFolder,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Summary:
    """Write a measured BTF as a data set, or finish an unfinished one.

    Parameters
    ----------
    job : Import
        The measured BTF and the options.
    folder : str or Path
        Output folder, or a URL.
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
    folder = DataFolder.open(folder)
    manifest = _manifest(job)
    with owned(folder.workspace):
        if holds_dataset(folder):
            if overwrite:
                folder.clear()
            else:
                _check_same(folder, manifest)
        make_folder(folder.workspace)
        if not folder.has(MANIFEST_NAME):
            folder.write(MANIFEST_NAME, checksummed(manifest))
        folder.write(CONFIG_NAME, dump_yaml(manifest["config"]).encode())
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


def _check_same(folder: DataFolder, manifest: dict[str, Any]) -> None:
    old = folder.read_json(MANIFEST_NAME)
    if old.get("config_hash") != manifest["config_hash"]:
        after = {**manifest["config"], "inputs": manifest["inputs"], "schema": SCHEMA_VERSION}
        raise other_data_set(folder, old, after)
    read_manifest(folder)


def _of_images(
    job: Import, source: MeasuredBtf, folder: DataFolder
) -> Iterator[tuple[ShardEntry, Arrays | None]]:
    """Shards with their arrays; None where the shard is finished already."""
    assert job.pairs is not None
    factor = np.full(len(source.light), job.config.scale, np.float32)
    if job.divides_by_cosine:
        factor /= source.light[:, 2]
    for pairs, split in zip(job.pairs, SPLITS, strict=True):
        entries = job.entries(split)
        size = max(1, source.at_once // job.config.output.shard_queries)
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
    for number, (block, usable) in enumerate(usable_blocks(source, job.config.queries.min_cos)):
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


def _store(job: Import, folder: DataFolder, plan: str, entry: ShardEntry, arrays: Arrays) -> None:
    """Write a shard and its sidecar."""
    started = time.perf_counter()

    def record(stored: Stored) -> dict[str, Any]:
        return sidecar(
            entry,
            stored,
            config_hash=job.config_hash,
            plan=plan,
            seed=job.config.seed,
            spp=None,
            queries=entry.rows,
            paths=0,
            seconds=round(time.perf_counter() - started, 4),
            quarantined={"nonfinite_samples": 0, "lost_rays": 0, "capped_rays": 0, "nonfinite_at": []},
            target=None,
            mean_value=arrays["value_a"].mean(axis=0, dtype=np.float64).tolist(),
            # Unknown: a query has a single value.
            mean_variance=None,
        )

    measured = {name: arrays[name] for name in MEASURED}
    folder.write_shard(entry.file, lambda path: write_shard(path, measured), record)
