"""Makes a data set: material and configuration in, folder of shards out. Resumes where it stopped."""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import PartialError, UsageError
from mbtf_core.lattice import Lattice
from mbtf_core.shard_schema import SPLITS, Split
from mbtf_gen.config.generator import GeneratorConfig, count_queries
from mbtf_gen.dataset.folder import holds, open_folder
from mbtf_gen.dataset.manifest import ShardEntry, build_manifest
from mbtf_gen.dataset.render_shards import ProgressCallback, busy_message, make_shards
from mbtf_gen.dataset.shard_io import shard_suffix
from mbtf_gen.dataset.summary import Summary, finish, planned_effects
from mbtf_gen.dataset.verify import is_finished
from mbtf_gen.geometry.heightfield import HeightGrid
from mbtf_gen.geometry.slopes import residual_slopes
from mbtf_gen.material.material import Material, load_material
from mbtf_gen.planning.adaptive import PILOT_SPP, Target
from mbtf_gen.planning.effects import EffectsPlan
from mbtf_gen.planning.effects_plan import SMALL_RUN, plan_effects, simulated
from mbtf_gen.planning.sample_allocation import measure_allocation
from mbtf_gen.planning.simulation import estimator_of
from mbtf_gen.sampling.query_sampler import Mixture, QueryPlan

log = logging.getLogger(__name__)

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
        job = cls.of(config, load_material(Path(config.material), config.geometry.make_tileable))
        for note in job.material.notes:
            log.info(note)
        for warning in job.material.warnings_at(config.geometry.height_scale):
            log.warning(warning)
        log.info(
            "mesh: %d x %d cells, relief %.4g tile widths",
            *job.grid.z.shape[::-1],
            job.grid.displacement_range,
        )
        return job

    @classmethod
    def of(cls, config: GeneratorConfig, material: Material) -> Job:
        """The job of a material that is loaded."""
        rows, columns = material.height.shape
        lattice = Lattice.for_map(rows, columns, config.queries.finest)
        return cls(config, material, lattice, config.hash(material.digests))

    def plan(self) -> QueryPlan:
        """How queries are drawn."""
        queries = self.config.queries
        try:
            mixture = Mixture(queries.mixture.log_uniform, queries.mixture.finest)
        except ValueError as error:
            raise UsageError(str(error), where="queries.mixture") from None
        return QueryPlan(
            self.lattice,
            mixture,
            queries.min_cos,
            queries.layout,
            self.config.seed,
            self._shard_rows(),
            queries.patch_size,
        )

    @property
    def places(self) -> int:
        """Queries per row of a shard: one, or those of a buffer."""
        queries = self.config.queries
        if queries.layout == "shuffled":
            return 1
        return self.lattice.texels() if queries.patch_size is None else queries.patch_size**2

    def _shard_rows(self) -> int:
        return max(1, self.config.output.shard_queries // self.places)

    @cached_property
    def grid(self) -> HeightGrid:
        """Heights of the mesh."""
        return self.material.grid(self.config.geometry.height_scale, self.config.geometry.mesh)

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

    def target(self, split: Split) -> Target | None:
        """Error to reach in place of a number of paths."""
        error = self.config.queries.target_error
        if split != "train" or error is None:
            return None
        return Target(error, self.config.queries.max_spp)

    def paths(self, entry: ShardEntry) -> int:
        """Paths that a shard takes."""
        return self._queries(entry) * self.spp(entry.split)

    def all_paths(self) -> int:
        """Paths of the whole data set."""
        return sum(self.paths(entry) for split in SPLITS for entry in self.shards(split))

    def most_paths(self) -> int:
        """Paths that the whole data set may take: under a target error what pilots and cap allow."""
        total = 0
        for split in SPLITS:
            target = self.target(split)
            most = self.spp(split) if target is None else target.cap + PILOT_SPP
            total += self.queries(split) * most
        return total

    def queries(self, split: Split) -> int:
        """Queries of a split, whole buffers counted in the image layout."""
        return sum(self._queries(entry) for entry in self.shards(split))

    def _queries(self, entry: ShardEntry) -> int:
        return entry.rows * self.places

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
            rows = max(1, math.ceil(rows / self.places))
        size = self._shard_rows()
        if rows > size * MAX_SHARD_FILES:
            raise UsageError(
                f"{wanted} {split} queries are more than {MAX_SHARD_FILES} shards of {size}",
                where="queries",
                hint="ask for fewer, or raise output.shard_queries",
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


def plan_run(job: Job) -> EffectsPlan:
    """Effects that a run simulates, and which queries get how many paths; by pilots where they pay."""
    return allocated(job, plan_effects(job, pilots=_is_large(job)))


def _is_large(job: Job) -> bool:
    return job.all_paths() >= SMALL_RUN


def allocated(job: Job, plan: EffectsPlan) -> EffectsPlan:
    """A plan with the allocation of a run under it: by a pilot under a target error and in large runs."""
    queries = job.config.queries
    wanted = queries.target_error is not None or (_is_large(job) and queries.allocation == "noise")
    if plan.closed_form or not wanted:
        return plan
    return replace(plan, allocation=measure_allocation(job, plan))


def _agreed_effects(job: Job, folder: Path, entries: list[ShardEntry], overwrite: bool) -> EffectsPlan:
    """Claim the folder and say which effects are simulated: as its manifest says where it has one, so that
    all shards of a data set show the same, whichever machine makes them."""
    like = build_manifest(job, entries, None)

    def begin() -> dict[str, Any]:
        return build_manifest(job, entries, plan_run(job))

    open_folder(job, folder, like, begin, overwrite)
    return planned_effects(folder)


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
    overwrite : replace what is there; slices keep a data set of the same configuration, which others of
        them may have begun
    slice_index, slice_count : make only shards i with ``i % slice_count == slice_index - 1``
    progress : called with (paths so far in this run, as planned, note), see :func:`paths_left`
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
    entries = [e for split in SPLITS for e in job.shards(split)]
    overwrite = overwrite and not (slice_count > 1 and holds(folder, job.config_hash))
    effects = _agreed_effects(job, folder, entries, overwrite)
    made = make_shards(job, folder, job.slice(slice_index, slice_count), effects, progress=progress)
    if made.busy:
        raise PartialError(
            busy_message(made.busy), where=folder, hint="wait for it, then run the same command again"
        )
    summary = finish(
        folder,
        paths=made.paths,
        seconds=time.perf_counter() - start,
        writing=made.writing,
        waiting=made.waiting,
    )
    if slice_count == 1 and not summary.complete:
        raise PartialError(
            "shards that were finished are gone or cannot be read",
            where=folder,
            hint="run the same command again",
        )
    return summary
