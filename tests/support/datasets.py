"""Finished data sets without rendering: real queries, manifest and sidecars, values from a formula."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.documents import Quarantined, Sidecar, Statistics
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.schema import Queries
from mbtf_core.data.shard_files import read_shard, write_shard
from mbtf_core.files.atomic import Stored, checksummed, file_sha256, parse_checksummed
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation.folder import open_folder
from mbtf_gen.generation.manifest import finish
from mbtf_gen.generation.run import ShardRun
from mbtf_gen.planning.highlights import Highlights
from mbtf_gen.planning.job import Job, split_spp
from mbtf_gen.planning.run_plan import RunPlan, reference_plan
from mbtf_gen.render.estimates import Estimates

F32 = NDArray[np.float32]
NOISE = 0.05


def formula(queries: Queries) -> NDArray[np.float64]:
    """Noise-free values (..., 3): smooth in every query variable."""
    u, s = queries.u.astype(np.float64), queries.sigma.astype(np.float64)
    base = 0.3 + 0.1 * np.sin(2 * np.pi * (u[..., 0] - 2 * u[..., 1])) * np.exp(-4 * s)
    shade = 0.5 + 0.5 * queries.omega_i[..., 2] * queries.omega_o[..., 2]
    return (base * shade)[..., None] * np.array([1.0, 0.8, 0.5])


def write_dataset(
    folder: Path, *, rows: int = 4, columns: int = 8, highlights: Highlights | None = None, **options: Any
) -> Dataset:
    """Write a data set of a random height map of `rows` × `columns` texels.

    Parameters
    ----------
    highlights : by which test queries are drawn
    options : sections of the configuration, as :class:`~mbtf_gen.config.generator.GeneratorConfig` takes them
    """
    heights = folder.parent / f"{folder.name}.npy"
    folder.parent.mkdir(parents=True, exist_ok=True)
    np.save(heights, 0.1 * np.random.default_rng(0).random((rows, columns)))
    config = GeneratorConfig.model_validate({"material": str(heights), **options})
    job = Job.load(config)
    plan = RunPlan(reference_plan(job), highlights=highlights)
    files = DataFolder.open(folder)
    open_folder(job, files, lambda job: plan)
    run = ShardRun(job, files, plan)
    for number, entry in enumerate(job.shards):
        queries, weight = run.draw(entry)
        truth, rng = formula(queries), np.random.default_rng(number)
        a, b = ((truth * (1 + NOISE * rng.normal(size=truth.shape))).astype(np.float32) for _ in range(2))
        paths = queries.sigma.size * split_spp(config, entry.split)
        made = Estimates(a.reshape(-1, 3), b.reshape(-1, 3), None, paths, 0, 0, 0)
        run.store(entry, queries, made, 0.1, weight)
    finish(folder)
    return Dataset.open(folder)


def edit(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change a manifest or a sidecar by hand, its checksum with it."""
    document = json.loads(path.read_text())
    change(document)
    path.write_bytes(checksummed(document))


def write_sidecar(shard: Path, split: str, index: int, config_hash: str, **changes: Any) -> None:
    """The sidecar of a shard that is written without a run."""
    arrays = read_shard(shard)
    halves = [arrays[name].reshape(-1, 3) for name in ("value_a", "value_b") if name in arrays]
    mean = sum(a.mean(axis=0, dtype=np.float64) if len(a) else np.zeros(3) for a in halves) / len(halves)
    stored = Stored(shard.stat().st_size, file_sha256(shard))
    record = Sidecar(
        config_hash=config_hash,
        plan="",
        file=shard.name,
        split=split,
        index=index,
        rows=len(arrays["sigma"]),
        **asdict(stored),
        seed={"root": 0, "split": split, "shard": index},
        spp=2,
        queries=arrays["sigma"].size,
        paths=0,
        seconds=0.0,
        quarantined=Quarantined(),
        target=None,
        statistics=Statistics(mean_value=np.nan_to_num(mean).tolist(), mean_variance=None),
    ).as_dict()
    shard.with_suffix(".json").write_bytes(checksummed({**record, **changes}))


def rewrite(shard: Path, **arrays: F32) -> None:
    """Replace arrays of a shard, with a sidecar that agrees."""
    write_shard(shard, {**read_shard(shard, mapped=False), **arrays})
    record = json.loads(shard.with_suffix(".json").read_text())
    kept = {key: record[key] for key in ("split", "index", "config_hash", "file")}
    write_sidecar(shard, **kept)


def _copy(data: Path, source: Path, suffixes: tuple[str, ...], number: int = 1) -> None:
    """Put shard 0 or 1 of a data set in the place of shard 1 of `data`."""
    for suffix in suffixes:
        shutil.copy(source / f"train-{number:05d}{suffix}", data / f"train-00001{suffix}")


def _change(data: Path, suffix: str, name: str, change: Callable[[F32], F32]) -> None:
    shard = data / f"train-00001{suffix}"
    rewrite(shard, **{name: change(read_shard(shard, mapped=False)[name])})


def _times(factor: float) -> Callable[[F32], F32]:
    return lambda array: (array * factor).astype(np.float32)


def _downwards(omega: F32) -> F32:
    return omega * np.array([1, 1, -1], np.float32)


# Damages that leave a readable data set: how, of (data, another run's data, suffix), and what is said of it.
FOREIGN: dict[str, tuple[Callable[[Path, Path, str], object], str]] = {
    "shard": (lambda d, o, s: _copy(d, o, (s,)), "not the shard that its sidecar describes"),
    "shard with sidecar": (lambda d, o, s: _copy(d, o, (s, ".json")), "belongs to another data set"),
    "copy": (lambda d, o, s: _copy(d, d, (s,), 0), "not the shard that its sidecar describes"),
    "copy with sidecar": (lambda d, o, s: _copy(d, d, (s, ".json"), 0), "has the sidecar of train-00000"),
    "manifest": (lambda d, o, s: shutil.copy(o / "manifest.json", d), "belongs to another data set"),
    "index": (
        lambda d, o, s: edit(d / "train-00001.json", lambda record: record.update(index=2)),
        "has the index 2, manifest.json says 1",
    ),
    "split": (
        lambda d, o, s: edit(d / "train-00001.json", lambda record: record.update(split="test")),
        "has the split test, manifest.json says train",
    ),
    "negative sigma": (lambda d, o, s: _change(d, s, "sigma", _times(-1)), "'sigma' holds numbers that"),
    "long vectors": (lambda d, o, s: _change(d, s, "omega_i", _times(1.001)), "'omega_i' holds vectors that"),
    "downwards": (lambda d, o, s: _change(d, s, "omega_o", _downwards), "'omega_o' holds vectors that"),
    "other tile": (
        lambda d, o, s: _change(d, s, "u", lambda u: u + 1),
        r"'u' holds numbers outside \[0, 1\)",
    ),
    "NaN": (lambda d, o, s: _change(d, s, "spp", _times(np.nan)), "'spp' holds NaN or infinite numbers"),
}


def flip(path: Path, at: int) -> None:
    """Flip a bit of a file."""
    content = bytearray(path.read_bytes())
    content[at] ^= 4
    path.write_bytes(content)


def read_checksummed(path: Path) -> dict[str, Any]:
    """Content of a checksummed document, which is intact."""
    return parse_checksummed(path.read_bytes(), path)
