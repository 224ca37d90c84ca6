"""Makes a data set: material and configuration in, folder of shards out. Resumes where it stopped."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .atomic import digest, write_json
from .config import GeneratorConfig, count_queries
from .effects import EffectsPlan
from .errors import PartialError, UsageError
from .estimates import Stream
from .heightfield import HeightGrid
from .levels import Lattice
from .locks import shard_lock
from .manifest import ShardEntry, build_manifest
from .material import Material, load_material
from .output_folder import open_folder
from .planning import SMALL_RUN, plan_effects, simulated
from .queries import Mixture, QueryPlan
from .schema import FORMAT_NAME, MANIFEST_NAME, SCHEMA_VERSION, SPLITS, Split
from .shard_files import shard_suffix, write_shard
from .simulation import estimator_of
from .slopes import residual_slopes
from .summary import Summary, finish, planned_effects, refuse_nonfinite
from .verification import is_finished, sidecar_of

log = logging.getLogger(__name__)

ProgressCallback = Callable[[float, str], None]

# A folder and a manifest of more are of no use to anyone.
MAX_SHARD_FILES = 1_000_000


@dataclass(frozen=True)
class Job:
    """A configuration with its material loaded: everything that decides the data."""

    config: GeneratorConfig
    material: Material
    lattice: Lattice
    config_hash: str
    _tiles: dict[Any, Any] = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def prepare(cls, config: GeneratorConfig) -> Job:
        """Load the material and resolve what depends on it.

        Raises
        ------
        InputError : the material cannot be used
        """
        job = cls.of(config, load_material(Path(config.material), config.geometry.tile))
        for note in job.material.notes:
            log.info(note)
        for warning in job.material.warnings_at(config.geometry.height):
            log.warning(warning)
        log.info("mesh: %d x %d cells, relief %.4g tile widths", *job.grid.z.shape[::-1], job.grid.relief)
        return job

    @classmethod
    def of(cls, config: GeneratorConfig, material: Material) -> Job:
        """The job of a material that is loaded."""
        rows, columns = material.height.shape
        lattice = Lattice.for_map(rows, columns, config.queries.levels)
        return cls(config, material, lattice, config.hash(material.digests))

    def plan(self) -> QueryPlan:
        """How queries are drawn."""
        queries = self.config.queries
        try:
            mixture = Mixture(queries.mixture.log_uniform, queries.mixture.finest)
        except ValueError as error:
            raise UsageError(str(error), where="queries.mixture") from None
        return QueryPlan(
            self.lattice, mixture, queries.min_cos, queries.layout, self.config.seed, self._shard_rows()
        )

    def _shard_rows(self) -> int:
        per_shard = self.config.output.shard_queries
        if self.config.queries.layout == "image":
            return max(1, per_shard // self.lattice.texels())
        return per_shard

    @cached_property
    def grid(self) -> HeightGrid:
        """Heights of the mesh."""
        return self.material.grid(self.config.geometry.height, self.config.geometry.mesh)

    @cached_property
    def residual(self) -> tuple[NDArray[np.float64], float] | None:
        """Slopes that the normal map adds to the mesh's, and the share of the mesh's that it repeats; None
        without a map or where it is switched off."""
        material, mode = self.material, self.config.effects.normal
        if material.normal is None or material.bsdf is not None or mode == "off":
            return None
        return residual_slopes(material.normal, self.grid, mode)

    def estimator(self, plan: EffectsPlan) -> Any:
        """Estimator of M under an effects plan; loads Mitsuba unless M has a closed form."""
        return estimator_of(self, plan, self._tiles)

    def spp(self, split: Split) -> int:
        """Paths per query of a split, both halves together."""
        return self.config.queries.spp if split == "train" else self.config.queries.test_spp

    def paths(self, entry: ShardEntry) -> int:
        """Paths that a shard takes."""
        return self._queries(entry) * self.spp(entry.split)

    def queries(self, split: Split) -> int:
        """Queries of a split, whole buffers counted in the image layout."""
        return sum(self._queries(entry) for entry in self.shards(split))

    def _queries(self, entry: ShardEntry) -> int:
        return entry.rows * (self.lattice.texels() if self.config.queries.layout == "image" else 1)

    def slice(self, index: int, count: int) -> list[ShardEntry]:
        """Shards of slice number `index` (from 1) of `count`: every `count`-th of all splits' shards."""
        entries = [e for split in SPLITS for e in self.shards(split)]
        return [e for k, e in enumerate(entries) if k % count == index - 1]

    def shards(self, split: Split) -> list[ShardEntry]:
        """Shards of a split and their rows.

        Raises
        ------
        UsageError : more than ``MAX_SHARD_FILES``
        """
        wanted = self.config.queries.train if split == "train" else self.config.queries.test
        rows = count_queries(wanted, self.lattice.texels())
        if self.config.queries.layout == "image":
            rows = max(1, math.ceil(rows / self.lattice.texels()))
        size = self._shard_rows()
        if rows > size * MAX_SHARD_FILES:
            raise UsageError(
                f"{wanted} {split} queries are more than {MAX_SHARD_FILES} shards of {size}",
                where="queries",
                cure="ask for fewer, or raise output.shard_queries",
            )
        suffix = shard_suffix(self.config.output.format)
        return [
            ShardEntry(split, index, f"{split}-{index:05d}{suffix}", min(size, rows - index * size))
            for index in range(math.ceil(rows / size))
        ]


def build_estimator(config: GeneratorConfig, material: Material) -> Any:
    """Estimator that simulates everything a material calls for, as reference pictures want it; loads
    Mitsuba."""
    job = Job.of(config, material)
    return job.estimator(simulated(job))


def _agreed_effects(job: Job, folder: Path, entries: list[ShardEntry], overwrite: bool) -> EffectsPlan:
    """Claim the folder and say which effects are simulated: as its manifest says where it has one, so that
    all shards of a data set show the same, whichever machine makes them."""
    existing = folder / MANIFEST_NAME
    if existing.exists() and not overwrite:
        open_folder(job, folder, build_manifest(job, entries, None), overwrite)
    else:
        large = sum(job.paths(entry) for entry in entries) >= SMALL_RUN
        open_folder(job, folder, build_manifest(job, entries, plan_effects(job, pilots=large)), overwrite)
    return planned_effects(folder)


def _sidecar(job: Job, entry: ShardEntry, path: Path, estimates: Any, seconds: float) -> dict[str, Any]:
    a = estimates.value_a.astype(np.float64)
    b = estimates.value_b.astype(np.float64)
    return {
        "format": FORMAT_NAME,
        "schema": SCHEMA_VERSION,
        "config_hash": job.config_hash,
        "file": path.name,
        "split": entry.split,
        "index": entry.index,
        "rows": entry.rows,
        "bytes": path.stat().st_size,
        "sha256": digest(path),
        "seed": {"root": job.config.seed, "split": entry.split, "shard": entry.index},
        "spp": job.spp(entry.split),
        "queries": len(a),
        "paths": estimates.paths,
        "seconds": round(seconds, 4),
        "quarantined": {
            "nonfinite_samples": estimates.nonfinite,
            "lost_rays": estimates.lost,
            "capped_rays": estimates.capped,
            "nonfinite_at": [asdict(bad) for bad in estimates.bad_samples],
        },
        "statistics": {
            "mean_value": (0.5 * (a + b)).mean(axis=0).tolist(),
            "mean_variance": (0.25 * (a - b) ** 2).mean(axis=0).tolist(),
        },
    }


def _make_shard(job: Job, plan: QueryPlan, estimator: Any, entry: ShardEntry, path: Path) -> dict[str, Any]:
    start = time.perf_counter()
    queries = plan.draw(entry.split, entry.index, entry.rows)
    flat = queries.flat()
    spp = job.spp(entry.split)
    estimates = estimator.estimate(flat, spp, Stream(job.config.seed, entry.split, entry.index))
    lead, through = queries.lead, estimates.transmittance
    write_shard(
        path,
        {
            "u": queries.u,
            "sigma": queries.sigma,
            "omega_i": queries.omega_i,
            "omega_o": queries.omega_o,
            "value_a": estimates.value_a.reshape(*lead, 3),
            "value_b": estimates.value_b.reshape(*lead, 3),
            "spp": np.full(lead, spp, np.float32),
            **({} if through is None else {"transmittance": through.reshape(lead)}),
        },
    )
    record = _sidecar(job, entry, path, estimates, time.perf_counter() - start)
    write_json(sidecar_of(path), record)
    return record


def paths_left(job: Job, folder: str | Path, slice_index: int = 1, slice_count: int = 1) -> int:
    """Paths that :func:`generate` has still to trace: those of the slice's shards that are not finished."""
    return sum(
        job.paths(entry)
        for entry in job.slice(slice_index, slice_count)
        if not is_finished(Path(folder) / entry.file, entry.rows, job.config_hash)
    )


def generate(
    config: GeneratorConfig,
    folder: str | Path,
    *,
    overwrite: bool = False,
    slice_index: int = 1,
    slice_count: int = 1,
    progress: ProgressCallback | None = None,
    job: Job | None = None,
) -> Summary:
    """Make (or finish) a data set.

    Parameters
    ----------
    folder : output; an unfinished data set of the same configuration there is resumed
    overwrite : replace a data set of another configuration
    slice_index, slice_count : make only shards i with ``i % slice_count == slice_index - 1``
    progress : called with (paths traced so far in this run, note), see :func:`paths_left`
    job : the configuration with its material loaded, where the caller has it already

    Raises
    ------
    InputError : material or folder cannot be used
    PartialError : shards are left to others, or the disk is full; the same command resumes. Too many
        non-finite samples; says where
    """
    folder = Path(folder)
    start = time.perf_counter()
    job = job or Job.prepare(config)
    plan = job.plan()
    entries = [e for split in SPLITS for e in job.shards(split)]
    effects = _agreed_effects(job, folder, entries, overwrite)
    paths, busy, made = 0, [], []
    estimator: Any = None
    for entry in job.slice(slice_index, slice_count):
        path = folder / entry.file
        if not is_finished(path, entry.rows, job.config_hash):
            with shard_lock(path) as held:
                if not held:
                    busy.append(entry.file)
                elif not is_finished(path, entry.rows, job.config_hash):
                    for stale in folder.glob(f".{path.stem}.*.tmp"):
                        stale.unlink(missing_ok=True)
                    if estimator is None:
                        estimator = job.estimator(effects)
                    record = _make_shard(job, plan, estimator, entry, path)
                    paths += record["paths"]
                    made.append(record)
                    # More than the whole data set may have: the rest cannot mend that.
                    refuse_nonfinite(made, sum(job.paths(e) for e in entries), folder)
        if progress is not None:
            progress(paths, f"{paths / max(time.perf_counter() - start, 1e-9) / 1e6:.2f} M paths/s")
    if busy:
        raise PartialError(
            f"{len(busy)} shard(s) are being written by another process, first {busy[0]}",
            where=folder,
            cure="wait for it, then run the same command again",
        )
    return finish(folder, paths=paths, seconds=time.perf_counter() - start)
