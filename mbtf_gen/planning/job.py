"""A data set to generate: configuration, material, and the queries and shards that follow from both."""

from __future__ import annotations

import logging
import math
import os
import shlex
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

from mbtf_core.data.lattice import Lattice
from mbtf_core.data.schema import SPLITS, ShardEntry, Split
from mbtf_core.data.shard_files import row_bytes
from mbtf_core.errors import InputError, UsageError
from mbtf_gen.config.generator import GeneratorConfig, count_queries
from mbtf_gen.render.estimates import TARGET_PILOT_SPP, Target
from mbtf_gen.sampling.query_sampler import (
    F32,
    UBO2003_COUNT,
    UBO2003_LOWEST,
    LevelMixture,
    QueryPlan,
    slice_directions,
)
from mbtf_gen.tile.loading import latest_material
from mbtf_gen.tile.protocol import Tile

log = logging.getLogger(__name__)

# Neither folders nor manifests are usable with more.
MAX_SHARD_FILES = 1_000_000


@dataclass(frozen=True)
class Job:
    """A configuration with its material loaded, under the options of the geometry: everything that determines
    the data."""

    config: GeneratorConfig
    material: Tile

    @classmethod
    def load(cls, config: GeneratorConfig) -> Job:
        """Load the material of a configuration, see :meth:`of`; an InputError if it cannot be used."""
        geometry = config.geometry
        return cls.of(config, latest_material(config.material, geometry.make_tileable, geometry.max_pixels))

    @classmethod
    def of(cls, config: GeneratorConfig, material: Tile) -> Job:
        """The job of a loaded material, whose height scale, tiling and resolution replace unset ones; a
        UsageError where options are for another kind of material."""
        geometry, queries = config.geometry, config.queries
        if queries.lights_per_path > 1 and queries.layout != "shuffled":
            what = f"{queries.layout} layout: its queries do not share paths"
            raise UsageError(what, where="--lights-per-path", hint="use 1, or --layout shuffled")
        tile = material.configured(geometry)
        found = {"height_scale": tile.height_scale, "make_tileable": tile.tiling}
        own = {
            "geometry": geometry.model_copy(update=found),
            "queries": queries.model_copy(update={"resolution": queries.resolution or tile.resolution}),
        }
        return cls(config.model_copy(update=own), tile)

    def announce(self) -> None:
        """Log how the material's files are read: its notes, warnings, and the options in use."""
        for note in self.material.notes:
            log.info(note)
        for warning in self.material.warnings_in_use():
            log.warning(warning)
        if (text := self.material.summary()) is not None:
            log.info(text)

    def announce_briefly(self) -> None:
        """Log the warning about the height scale, and how many others there are, for commands that make no
        data."""
        if (scale := self.material.scale_warning()) is not None:
            log.warning(scale)
        if count := len(self.material.warnings_in_use()) - (scale is not None):
            warnings = f"{count} warnings" if count > 1 else "1 warning"
            log.info(f"{warnings} about this material: mbtf-gen inspect {shlex.quote(self.config.material)}")

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled, it is its configuration and hash: the receiver, perhaps on another machine, loads the
        material itself."""
        fields = self.config.model_dump(mode="json", include=set(GeneratorConfig.model_fields))
        # Other processes may have other working folders.
        fields["material"] = os.path.abspath(self.config.material)
        config = GeneratorConfig.model_validate(fields)
        return received_job, (config.model_dump_json(), config.hash(self.material.digests))

    @cached_property
    def lattice(self) -> Lattice:
        """Texel grids of the levels."""
        return self.material.lattice(self.config.queries.finest)

    @property
    def inputs(self) -> dict[str, str]:
        """Role → SHA-256 of the input files."""
        return self.material.digests

    @cached_property
    def config_hash(self) -> str:
        """SHA-256 of the options and of the contents of the input files, hexadecimal."""
        return self.config.hash(self.material.digests)

    @cached_property
    def slice_directions(self) -> F32 | None:
        """Directions (n, 3) of the slices layout, lights and views alike; None in other layouts. A UsageError
        if the number of training queries does not suit them."""
        queries, texels = self.config.queries, self.lattice.texels()
        if queries.layout != "slices":
            return None
        each, rest = divmod(count_queries(queries.train, texels), texels)
        if queries.slice_directions == "ubo2003":
            if (each, rest) != (UBO2003_COUNT**2, 0):
                raise UsageError(f"the slices of ubo2003 need {UBO2003_COUNT**2}/texel", where="--queries")
            if queries.min_cos > UBO2003_LOWEST:
                hint = f"use --min-cos {UBO2003_LOWEST - 5e-3:.2f} or less"
                raise UsageError("the directions of ubo2003 are lower", where="--min-cos", hint=hint)
        if each < 1:
            what = "slices need at least one query per texel"
            raise UsageError(what, where="--queries", hint="400/texel")
        return slice_directions(queries.slice_directions, math.isqrt(each), queries.min_cos)

    @cached_property
    def query_plan(self) -> QueryPlan:
        """Samples the queries of any shard; a UsageError if all weights of the mixture are zero."""
        queries = self.config.queries
        try:
            mixture = LevelMixture(queries.mixture.log_uniform, queries.mixture.finest)
        except ValueError as error:
            raise UsageError(str(error), where="queries.mixture") from None
        return QueryPlan(
            self.lattice,
            mixture,
            queries.min_cos,
            queries.layout,
            self.config.seed,
            shard_rows(self),
            queries.patch_size,
            self.slice_directions,
            queries.lights_per_path,
        )

    @cached_property
    def shards(self) -> tuple[ShardEntry, ...]:
        """All shards, the training split first; a UsageError if a split has more than ``MAX_SHARD_FILES``."""
        return tuple(entry for split in SPLITS for entry in _shards(self, split))


@lru_cache(maxsize=1)
def received_job(config: str, config_hash: str) -> Job:
    """The job of another process, from its configuration as JSON, kept for its next task; an InputError if
    the material's files differ from those of the sender."""
    job = Job.load(GeneratorConfig.model_validate_json(config))
    if job.config_hash != config_hash:
        raise InputError("the material's files differ on this machine", where=job.config.material)
    return job


def limit_resolution(job: Job) -> Job:
    """A job whose resolution is that of a preset: the material's own overrides it, and maps of lower
    resolution have no finer detail."""
    own, preset = job.material.resolution, job.config.queries.resolution
    highest = 1 << job.material.lattice().finest
    if preset is None or (own is None and preset <= highest):
        return job
    queries = job.config.queries.model_copy(update={"resolution": highest})
    return replace(job, config=job.config.model_copy(update={"queries": queries}))


def row_queries(job: Job, split: Split) -> int:
    """Queries in one row of a shard: one, or those of an image, or those of a training slice."""
    queries = job.config.queries
    if queries.layout == "image":
        return job.lattice.texels() if queries.patch_size is None else queries.patch_size**2
    directions = job.slice_directions
    return 1 if directions is None or split == "test" else len(directions) ** 2


def shard_rows(job: Job) -> int:
    """Rows of a full shard, whole groups."""
    lights = split_lights(job.config, "train")
    return lights * max(1, job.config.output.shard_queries // (lights * row_queries(job, "train")))


def _shards(job: Job, split: Split) -> list[ShardEntry]:
    config = job.config
    count = config.queries.train if split == "train" else config.queries.test
    rows = math.ceil(count_queries(count, job.lattice.texels()) / row_queries(job, split))
    if split == "train" and config.queries.layout == "slices":
        rows = job.lattice.texels()
    lights, size = split_lights(config, split), shard_rows(job)
    rows = lights * math.ceil(rows / lights)
    if rows > size * MAX_SHARD_FILES:
        raise UsageError(
            f"{count} {split} queries are more than {MAX_SHARD_FILES} shards of {size}",
            where="queries",
            hint="reduce them, or raise output.shard_queries",
        )
    return shard_entries(split, rows, size, config.output.format)


def shard_entries(split: Split, rows: int, size: int, suffix: str) -> list[ShardEntry]:
    """Shards of `rows` rows in all, of `size` rows each but for the last one."""
    names = (f"{split}-{index:05d}.{suffix}" for index in range(-(-rows // size)))
    return [ShardEntry(split, k, name, min(size, rows - k * size)) for k, name in enumerate(names)]


def split_spp(config: GeneratorConfig, split: Split) -> int:
    """Mean number of paths per query of a split, both halves together."""
    return config.queries.spp if split == "train" else config.queries.test_spp


def split_lights(config: GeneratorConfig, split: Split) -> int:
    """Lights of each path of a split, the queries of a group. Test queries have paths of their own: error
    bars take them as independent."""
    return config.queries.lights_per_path if split == "train" else 1


def path_work(lights: int) -> float:
    """Time of a path of several lights over that of a path of one: each vertex has a ray of the path, and one
    towards each light."""
    return 0.5 * (1 + lights)


def split_target(config: GeneratorConfig, split: Split) -> Target | None:
    """Target error of a split; None where it has a number of paths."""
    error = config.queries.target_error
    return None if split != "train" or error is None else Target(error, config.queries.max_spp)


def split_queries(job: Job, split: Split) -> int:
    """Queries of a split; rounded up to whole groups and images, in the slices layout down to n² per
    texel."""
    return row_queries(job, split) * sum(entry.rows for entry in job.shards if entry.split == split)


def planned_paths(job: Job, entries: Iterable[ShardEntry]) -> int:
    """Paths of some shards; a target error may change them."""

    def paths(entry: ShardEntry) -> float:
        config, split = job.config, entry.split
        return entry.rows * row_queries(job, split) * split_spp(config, split) / split_lights(config, split)

    return round(sum(map(paths, entries)))


def most_paths(job: Job) -> int:
    """Paths of the whole data set at most: under a target error the pilots and the cap count."""
    total = 0
    for split in SPLITS:
        target = split_target(job.config, split)
        spp = split_spp(job.config, split) if target is None else target.max_spp + TARGET_PILOT_SPP
        total += split_queries(job, split) * spp // split_lights(job.config, split)
    return total


def data_bytes(job: Job, entries: Iterable[ShardEntry]) -> int:
    """Bytes of some shards of a job."""
    queries = sum(entry.rows * row_queries(job, entry.split) for entry in entries)
    return queries * row_bytes(job.material.transmits)
