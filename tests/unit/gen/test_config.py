"""Configurations: counts, limits and hash; jobs: shards, queries and paths that follow from them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mbtf_core.config.settings import resolve
from mbtf_core.errors import InputError, UsageError
from mbtf_gen.config.exchange import PublishConfig
from mbtf_gen.config.generator import GeneratorConfig, count_queries
from mbtf_gen.planning.job import Job, most_paths, planned_paths, split_queries
from mbtf_gen.tile.loading import load_material


def test_counts() -> None:
    whole = {"1": 1, "100000": 100_000, "1e6": 1_000_000, "1.5e3": 1500, 7: 7}
    per_texel = {"400/texel": 400 * 96, " 2 / texel ": 192, "0.5/texel": 48, "0.001/texel": 1}
    for text, count in (whole | per_texel).items():
        assert count_queries(text, 96) == count


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("queries.spp", 3, "even"),
        ("queries.resolution", 100, "power of two"),
        ("light.width", 1e-3, "delta light"),
        ("seed", 1 << 63, "9223372036854775808"),
    ],
)
def test_values_out_of_range_are_refused_with_key_and_reason(key: str, value: Any, says: str) -> None:
    with pytest.raises(UsageError) as caught:
        resolve(GeneratorConfig, flags={"material": "m", key: value})
    assert key in caught.value.what
    assert says in caught.value.what


@pytest.mark.parametrize(
    ("spellings", "stored"),
    [(["400/texel", " 400 / texel", "4e2/texel"], "400/texel"), ([7, "7", 7.0, "7.0"], "7")],
)
def test_counts_have_one_spelling(spellings: list[Any], stored: str) -> None:
    for text in spellings:
        config = GeneratorConfig.model_validate({"material": "m", "queries": {"train": text}})
        assert config.queries.train == stored


def write_maps(folder: Path, *, height: float = 0.0, color: int = 100, suffix: str = "") -> Path:
    folder.mkdir()
    np.save(folder / f"height{suffix}.npy", np.full((2, 4), height))
    np.save(folder / f"base_color{suffix}.npy", np.full((2, 4, 3), color, np.uint8))
    return folder


def config_hash(folder: Path, **options: Any) -> str:
    config = GeneratorConfig.model_validate({"material": str(folder), **options})
    return config.hash(load_material(folder).digests)


def test_hash_ignores_names_and_places_but_not_contents(tmp_path: Path) -> None:
    base = config_hash(write_maps(tmp_path / "a"))
    assert config_hash(write_maps(tmp_path / "b", suffix="_2k")) == base
    assert config_hash(write_maps(tmp_path / "c", height=0.5)) != base
    assert config_hash(write_maps(tmp_path / "d", color=101)) != base
    swapped = write_maps(tmp_path / "e")
    (swapped / "base_color.npy").rename(swapped / "opacity.npy")
    assert config_hash(swapped) != base


CHANGES = (
    *("seed=1", "geometry.height_scale=0.5", "geometry.mesh=8", "geometry.make_tileable=mirror"),
    *("geometry.tracer=mesh",),
    *("light.width=2", "effects.mode=all", "effects.tolerance=0.01", "effects.normal=off"),
    *("transport.max_depth=3", "transport.roulette_depth=5", "transport.max_crossings=9"),
    *("output.format=exr", "output.shard_queries=99", "queries.train=3", "queries.test=3"),
    *("queries.spp=8", "queries.test_spp=8", "queries.allocation=uniform"),
    "queries.lights_per_path=2",
    *("queries.test_highlights=0.5", "queries.target_error=5%"),
    *("queries.max_spp=64", "queries.resolution=2", "queries.mixture.finest=0.3", "queries.min_cos=0.2"),
    *("queries.layout=image", "queries.patch_size=8", "queries.slice_directions=ubo2003"),
)


def test_hash_covers_every_option_but_the_materials_name(tmp_path: Path) -> None:
    folder = write_maps(tmp_path / "a")
    digests, flags = load_material(folder).digests, {"material": str(folder)}
    hashes = {resolve(GeneratorConfig, assignments=[c], flags=flags).hash(digests) for c in CHANGES}
    assert len(hashes | {config_hash(folder)}) == 1 + len(CHANGES)
    # Every option is in the list above, except a limit that does not change the data.
    listed = {tuple(change.partition("=")[0].split(".")[:2]) for change in CHANGES} - {("seed",)}
    fields = GeneratorConfig.model_fields
    known = {
        (s, k)
        for s in fields
        if hasattr(fields[s].annotation, "model_fields")
        for k in fields[s].annotation.model_fields  # type: ignore[union-attr]
    }
    assert listed == known - {("geometry", "max_displacement"), ("geometry", "max_pixels")}
    assert set(fields) - {s for s, _ in known} == {"version", "material", "seed"}


@pytest.mark.parametrize(
    "said",
    [
        {"license": "Creative Commons"},
        {"url": "ftp://example.org/a"},
        {"date": "2026-13-01"},
        {"name": "two\nlines"},
        {"name": "\x1b[2J"},
        {"citation": "x\x00"},
    ],
)
def test_what_cannot_be_published_is_refused(said: dict[str, Any]) -> None:
    with pytest.raises(InputError) as fault:
        PublishConfig.model_validate({"license": "MIT", **said})
    assert fault.value.what.startswith(f"'{next(iter(said))}")


def test_addresses_cannot_end_a_link() -> None:
    config = PublishConfig.model_validate({"license": "MIT", "url": "https://example.org/a b>`<x"})
    assert config.url == "https://example.org/a%20b%3E%60%3Cx"


@pytest.fixture
def heights(tmp_path: Path) -> Path:
    np.save(tmp_path / "height.npy", np.random.default_rng(0).random((4, 8)))
    return tmp_path / "height.npy"


def job_of(heights: Path, **queries: Any) -> Job:
    """A job of 100 training and 30 test queries on 4 x 8 texels, in shards of 40 queries."""
    options = {"train": "100", "test": "30", "spp": 2, "test_spp": 4, **queries}
    config = {"material": str(heights), "queries": options, "output": {"shard_queries": 40}}
    return Job.load(GeneratorConfig.model_validate(config))


def rows(job: Job, split: str = "train") -> list[tuple[str, int]]:
    return [(entry.file, entry.rows) for entry in job.shards if entry.split == split]


def test_shards_cover_the_rows(heights: Path) -> None:
    job = job_of(heights)
    assert rows(job) == [(f"train-{i:05d}.npz", n) for i, n in enumerate((40, 40, 20))]
    assert rows(job, "test") == [("test-00000.npz", 30)]
    # Image layout: whole images of 32 texels; 100 queries are four of them, one per shard.
    assert [n for _, n in rows(job_of(heights, layout="image"))] == [1] * 4
    # Patches of 9 texels: 100 queries are twelve of them, four per shard of 40 queries.
    patches = job_of(heights, layout="image", patch_size=3)
    assert [n for _, n in rows(patches)] == [4, 4, 4]
    assert split_queries(patches, "train") == 108
    assert sum(n for _, n in rows(job_of(heights, train="3/texel"))) == 96


def test_the_limit_of_the_displacement_range_can_be_raised(tmp_path: Path) -> None:
    np.save(tmp_path / "tall.npy", np.linspace(0.0, 200.0, 32).reshape(4, 8))

    def config(**geometry: float) -> GeneratorConfig:
        return GeneratorConfig.model_validate({"material": str(tmp_path / "tall.npy"), "geometry": geometry})

    with pytest.raises(InputError, match=r"200 tile widths; at most 100"):
        Job.load(config(height_scale=1.0)).announce()
    raised = Job.load(config(height_scale=1.0, max_displacement=300.0))
    assert raised.material.thickness == 200.0
    assert Job.load(config(height_scale=0.4)).material.thickness == 80.0
    # The limit does not change the data.
    assert raised.config_hash == Job.of(config(height_scale=1.0), raised.material).config_hash


def test_lights_of_a_path_share_it_in_whole_groups(heights: Path) -> None:
    job = job_of(heights, lights_per_path=3)
    # 100 queries are 34 groups, 13 of them per shard of 40 queries.
    assert [n for _, n in rows(job)] == [39, 39, 24]
    assert rows(job, "test") == [("test-00000.npz", 30)]
    assert split_queries(job, "train") == 102
    assert planned_paths(job, job.shards) == most_paths(job) == 34 * 2 + 30 * 4
    # Groups that do not fit into a shard make larger shards.
    assert [n for _, n in rows(job_of(heights, lights_per_path=64))] == [64, 64]
