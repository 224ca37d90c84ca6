"""Making a data set without rendering: shards, slices, claiming a folder, resuming, giving way to others."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.datasets import formula

from mbtf_core.atomic import checksummed, create_file
from mbtf_core.errors import InputError, PartialError, UsageError
from mbtf_core.locks import shard_lock
from mbtf_gen import generation
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.dataset import render_shards as shard_making
from mbtf_gen.dataset.manifest import build_manifest
from mbtf_gen.dataset.reader import Dataset
from mbtf_gen.dataset.shard_statistics import ShardStatistics, refuse_nonfinite
from mbtf_gen.dataset.summary import finish
from mbtf_gen.dataset.verify import sidecar_of, verify
from mbtf_gen.generation import Job, generate, paths_left
from mbtf_gen.render.runtime import load_mitsuba

load_mitsuba()

from mbtf_gen.render.estimates import BadSample, Estimates  # noqa: E402

SMALL = {
    "queries": {"train": "100", "test": "30", "spp": 2, "test_spp": 4},
    "output": {"shard_queries": 40},
}
FILES = ["train-00000.npz", "train-00001.npz", "train-00002.npz", "test-00000.npz"]


class Formula:
    """Stands in for the estimator: values from a formula, and a count of the shards it was asked for."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, int]] = []
        self.fail_at: int | None = None
        self.bad = (BadSample(7, "direct light"),)

    def estimate(self, queries: Any, spp: int, stream: Any) -> Any:
        if self.fail_at == len(self.asked):
            raise KeyboardInterrupt
        self.asked.append((stream.split, stream.shard))
        value = formula(queries).astype(np.float32)
        return Estimates(value, value, None, len(value) * spp, 1, 2, len(self.bad), self.bad)


@pytest.fixture
def engine(monkeypatch: pytest.MonkeyPatch) -> Formula:
    fake = Formula()
    monkeypatch.setattr(generation, "plan_effects", lambda job, pilots: generation.simulated(job))
    monkeypatch.setattr(generation, "estimator_of", lambda job, plan, tiles: fake)
    return fake


@pytest.fixture
def config(tmp_path: Path) -> GeneratorConfig:
    np.save(tmp_path / "height.npy", np.random.default_rng(0).random((4, 8)))
    return GeneratorConfig.model_validate({"material": str(tmp_path / "height.npy"), **SMALL})


def changed(config: GeneratorConfig, **sections: dict[str, Any]) -> GeneratorConfig:
    data = config.model_dump()
    for name, section in sections.items():
        data[name] = {**data[name], **section} if isinstance(section, dict) else section
    return GeneratorConfig.model_validate(data)


def contents(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.suffix == ".npz"}


def test_shards_cover_the_wanted_rows(config: GeneratorConfig) -> None:
    entries = Job.prepare(config).shards("train") + Job.prepare(config).shards("test")
    assert [(e.file, e.rows) for e in entries] == list(zip(FILES, (40, 40, 20, 30), strict=True))
    # Image layout: whole buffers, 32 texels each; 100 queries are four of them, one per shard.
    image = Job.prepare(changed(config, queries={"layout": "image"}))
    assert [(e.file, e.rows) for e in image.shards("train")] == [(f"train-{i:05d}.npz", 1) for i in range(4)]
    # Windows of 9 places: 100 queries are twelve of them, four per shard of 40 queries.
    windows = Job.prepare(changed(config, queries={"layout": "image", "patch_size": 3}))
    assert [e.rows for e in windows.shards("train")] == [4, 4, 4]
    assert windows.queries("train") == 108
    per_texel = Job.prepare(changed(config, queries={"train": "3/texel"}))
    assert sum(e.rows for e in per_texel.shards("train")) == 96


def test_more_shards_than_a_folder_can_hold_are_refused(config: GeneratorConfig) -> None:
    with pytest.raises(UsageError, match=r"shards of 40"):
        Job.prepare(changed(config, queries={"train": "1e12/texel"})).shards("train")


def test_a_run_is_complete_and_counts(config: GeneratorConfig, engine: Formula, tmp_path: Path) -> None:
    seen: list[float] = []
    summary = generate(config, tmp_path / "out", progress=lambda done, note: seen.append(done))
    # Progress counts paths: a test query takes twice as many as a training query.
    assert seen == [80, 160, 200, 320]
    assert (summary.complete, summary.queries, summary.paths) == (True, 130, 100 * 2 + 30 * 4)
    assert summary.splits == {"train": 100, "test": 30}
    assert (summary.lost, summary.capped, summary.nonfinite) == (4, 8, 4)
    assert summary.relative_error == 0.0
    data = Dataset.open(tmp_path / "out").load("train")
    np.testing.assert_allclose(summary.mean_value, data["value_a"].astype(np.float64).mean(axis=0), rtol=1e-6)
    assert set(data["spp"]) == {2.0}
    assert verify(tmp_path / "out") == []
    assert not list((tmp_path / "out").glob(".*"))


def test_progress_ends_where_it_was_to_end_whatever_queries_took(
    config: GeneratorConfig, engine: Formula, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As under a target error: time left follows from the share that is done."""
    real = Formula.estimate

    def more(self: Formula, *arguments: Any) -> Estimates:
        found: Estimates = real(self, *arguments)
        return dataclasses.replace(found, paths=7 * found.paths)

    monkeypatch.setattr(Formula, "estimate", more)
    seen: list[float] = []
    left = paths_left(Job.prepare(config), tmp_path / "out")
    summary = generate(config, tmp_path / "out", progress=lambda done, note: seen.append(done))
    assert seen == [80, 160, 200, 320]
    assert seen[-1] == left
    assert summary.paths == 7 * 320


def test_too_many_nonfinite_samples_fail_the_run_and_name_their_place(
    config: GeneratorConfig, engine: Formula, tmp_path: Path
) -> None:
    """Two a shard: four are let pass in any run, the sixth is not; nor do they pass on a second try."""
    engine.bad = (BadSample(7, "direct light"), BadSample(9, "interreflection"))
    place = "train-00000.npz query 7, direct light; train-00000.npz query 9, interreflection"
    with pytest.raises(PartialError, match=f"6 of 320 samples were NaN or infinite.*{place}"):
        generate(config, tmp_path / "out")
    assert len(contents(tmp_path / "out")) == 3
    with pytest.raises(PartialError, match=f"8 of 320 samples.*{place}"):
        generate(config, tmp_path / "out")
    with pytest.raises(PartialError, match="8 of 320"):
        finish(tmp_path / "out")
    assert not json.loads((tmp_path / "out/manifest.json").read_text())["complete"]


def test_samples_are_held_against_all_paths_that_a_target_error_may_take(config: GeneratorConfig) -> None:
    """A run is not stopped for samples that are few among its paths."""
    assert Job.prepare(config).most_paths() == Job.prepare(config).all_paths() == 320
    aimed = Job.prepare(changed(config, queries={"target_error": 0.02, "max_spp": 128}))
    assert aimed.most_paths() == 100 * (128 + 16) + 30 * 4


@pytest.mark.parametrize(
    ("count", "paths", "refused"), [(4, 1, False), (5, 4_999_999, True), (5, 5_000_000, False)]
)
def test_one_sample_in_a_million_may_be_nonfinite(count: int, paths: int, refused: bool) -> None:
    shard_statistics = ShardStatistics()
    quarantined = {"nonfinite_samples": count, "lost_rays": 0, "capped_rays": 0, "nonfinite_at": []}
    shard_statistics.add_quarantined("train-00000.npz", quarantined)
    with pytest.raises(PartialError) if refused else contextlib.nullcontext():
        refuse_nonfinite(shard_statistics, paths, Path("out"))


def test_the_same_command_resumes_without_rendering(
    config: GeneratorConfig, engine: Formula, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = generate(config, tmp_path / "out")
    before = {p.name: (p.stat().st_mtime_ns, p.read_bytes()) for p in (tmp_path / "out").iterdir()}

    def never(*_: Any) -> Any:
        raise AssertionError("the estimator was built although nothing is missing")

    monkeypatch.setattr(generation, "estimator_of", never)
    second = generate(config, tmp_path / "out")
    assert (second.paths, second.complete, second.mean_value) == (0, True, first.mean_value)
    assert before == {p.name: (p.stat().st_mtime_ns, p.read_bytes()) for p in (tmp_path / "out").iterdir()}


@pytest.mark.parametrize("done", range(4))
def test_an_interrupted_run_goes_on_where_it_stopped(
    config: GeneratorConfig, engine: Formula, tmp_path: Path, done: int
) -> None:
    generate(config, tmp_path / "whole")
    engine.asked.clear()
    engine.fail_at = done
    with pytest.raises(KeyboardInterrupt):
        generate(config, tmp_path / "out")
    assert len(contents(tmp_path / "out")) == done
    assert json.loads((tmp_path / "out/manifest.json").read_text())["complete"] is False
    engine.fail_at = None
    assert generate(config, tmp_path / "out").complete
    assert engine.asked == [("train", 0), ("train", 1), ("train", 2), ("test", 0)]
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


def test_what_a_kill_leaves_is_cleared_away(config: GeneratorConfig, engine: Formula, tmp_path: Path) -> None:
    out = tmp_path / "out"
    # Killed while the manifest was written: the folder holds a temporary file alone.
    out.mkdir()
    (out / ".manifest.json.0123abcd-123.tmp").write_text("{")
    generate(config, out)
    # Killed between manifest and configuration, within a shard, and between a shard and its sidecar.
    (out / "config.yaml").unlink()
    (out / FILES[0]).unlink()
    (out / f".{FILES[0]}.0123abcd-99999999.tmp").write_bytes(b"half")
    sidecar_of(out / FILES[0]).unlink()
    sidecar_of(out / FILES[1]).unlink()
    (out / ".train-00001.json.0123abcd-99999999.tmp").write_text("{")
    assert generate(config, out).complete
    assert verify(out) == []
    assert (out / "config.yaml").exists()
    assert [p.name for p in out.glob(".train*")] == []


def test_damage_that_changes_the_size_is_made_anew(
    config: GeneratorConfig, engine: Formula, tmp_path: Path
) -> None:
    generate(config, tmp_path / "out")
    path = tmp_path / "out" / FILES[2]
    intact = path.read_bytes()
    path.write_bytes(intact[:-7])
    engine.asked.clear()
    generate(config, tmp_path / "out")
    assert engine.asked == [("train", 2)]
    assert path.read_bytes() == intact


def test_another_configuration_is_refused_field_by_field_and_nothing_is_touched(
    config: GeneratorConfig, engine: Formula, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    generate(config, out)
    before = {p.name: p.read_bytes() for p in out.iterdir()}
    other = changed(config, queries={"spp": 8, "min_cos": 0.2}, light={"width": 3.0})
    with pytest.raises(InputError) as caught:
        generate(other, out)
    for part in ("light.width: 1.0 -> 3.0", "queries.min_cos: 0.1 -> 0.2", "queries.spp: 2 -> 8"):
        assert part in caught.value.what
    assert "--overwrite" in caught.value.hint
    np.save(tmp_path / "height.npy", np.zeros((4, 8)))
    with pytest.raises(InputError, match=r"inputs\.height"):
        generate(config, out)
    assert before == {p.name: p.read_bytes() for p in out.iterdir()}


def test_overwrite_replaces_the_data_set_and_nothing_else(
    config: GeneratorConfig, engine: Formula, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    generate(config, out)
    mine = {"notes.txt": "kept", ".hidden": "kept", "train-notes.json": "kept", "render.png": "kept"}
    for name, text in mine.items():
        (out / name).write_text(text)
    (out / ".git").mkdir()
    (out / ".train-00009.lock").write_text("{}")
    smaller = changed(config, queries={"train": "40"})
    assert generate(smaller, out, overwrite=True).complete
    assert {name: (out / name).read_text() for name in mine} == mine
    assert sorted(contents(out)) == ["test-00000.npz", "train-00000.npz"]
    assert not (out / ".train-00009.lock").exists()
    assert "train: '40'" in (out / "config.yaml").read_text()
    assert Dataset.open(out).manifest["complete"]


def test_a_kill_while_overwriting_leaves_a_data_set_that_can_be_overwritten(
    config: GeneratorConfig, engine: Formula, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    generate(config, out)
    count = len(list(out.iterdir()))
    unlink, removed = Path.unlink, 0

    def interrupted(path: Path, missing_ok: bool = False) -> None:
        nonlocal removed
        if removed == stop:
            raise KeyboardInterrupt
        removed += 1
        unlink(path, missing_ok=missing_ok)

    for stop in range(count):
        shutil.copytree(out, tmp_path / str(stop))
        removed = 0
        with monkeypatch.context() as patch:
            patch.setattr(Path, "unlink", interrupted)
            with pytest.raises(KeyboardInterrupt):
                generate(changed(config, light={"width": 3.0}), tmp_path / str(stop), overwrite=True)
        left = {p.name for p in (tmp_path / str(stop)).iterdir()}
        assert len(left) == count - stop
        assert "manifest.json" in left
        assert generate(changed(config, light={"width": 3.0}), tmp_path / str(stop), overwrite=True).complete


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize(
    "files",
    [
        {"notes.txt": "mine"},
        {"config.yaml": "mine"},
        {".env": "mine"},
        {"manifest.json": '{"name": "a web page"}', ".env": "mine", "train-1.png": "mine"},
        {"manifest.json": "{"},
        {"train-00000.npz": "an orphan"},
    ],
    ids=["notes", "config", "hidden", "foreign manifest", "broken manifest", "orphan"],
)
def test_folders_of_others_are_refused_untouched(
    files: dict[str, str], overwrite: bool, config: GeneratorConfig, engine: Formula, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    for name, text in files.items():
        (out / name).write_text(text)
    with pytest.raises(InputError):
        generate(config, out, overwrite=overwrite)
    assert {p.name: p.read_text() for p in out.iterdir()} == files


def test_a_file_in_place_of_the_folder_is_refused(
    config: GeneratorConfig, engine: Formula, tmp_path: Path
) -> None:
    for out in (tmp_path / "height.npy", tmp_path / "height.npy" / "below"):
        with pytest.raises(InputError):
            generate(config, out)


def test_paths_left_are_those_that_the_run_will_trace(
    config: GeneratorConfig, engine: Formula, tmp_path: Path
) -> None:
    job, out = Job.prepare(config), tmp_path / "out"
    # Shards of 40, 40, 20 training queries at 2 paths and 30 test queries at 4.
    assert paths_left(job, out) == 80 + 80 + 40 + 120
    assert [paths_left(job, out, i, 2) for i in (1, 2)] == [80 + 40, 80 + 120]
    engine.fail_at = 1
    with pytest.raises(KeyboardInterrupt):
        generate(config, out)
    engine.fail_at = None
    left = paths_left(job, out)
    assert left == 240
    seen: list[float] = []
    assert generate(config, out, progress=lambda done, note: seen.append(done)).paths == left
    # Shards that were there count for nothing, so that the time left is not underrated.
    assert seen == [0, 80, 120, 240]
    assert paths_left(job, out) == 0
    image = Job.prepare(changed(config, queries={"layout": "image"}))
    assert image.queries("train") == 4 * 32
    assert paths_left(image, out) == 4 * 32 * 2 + 32 * 4


def test_of_two_writers_that_begin_at_once_the_second_adopts_the_plan_of_the_first(
    config: GeneratorConfig, engine: Formula, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another process, whose plan differs, writes its manifest while this one plans."""
    out, job = tmp_path / "out", Job.prepare(config)
    entries = job.shards("train") + job.shards("test")
    other = generation.simulated(job)
    other = dataclasses.replace(other, cap_cost=0.125)

    def plan(job: Job, pilots: bool) -> Any:
        out.mkdir()
        assert create_file(out / "manifest.json", checksummed(build_manifest(job, entries, other)))
        return generation.simulated(job)

    monkeypatch.setattr(generation, "plan_effects", plan)
    assert generate(config, out).complete
    assert json.loads((out / "manifest.json").read_text())["effects"] == other.to_manifest()
    assert other.to_manifest() != generation.simulated(job).to_manifest()
    assert verify(out) == []


def test_of_two_writers_that_begin_different_data_sets_at_once_the_second_is_refused(
    config: GeneratorConfig, engine: Formula, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, another = tmp_path / "out", Job.prepare(changed(config, queries={"spp": 8}))
    content = checksummed(
        build_manifest(
            another, another.shards("train") + another.shards("test"), generation.simulated(another)
        )
    )

    def plan(job: Job, pilots: bool) -> Any:
        out.mkdir()
        assert create_file(out / "manifest.json", content)
        return generation.simulated(job)

    monkeypatch.setattr(generation, "plan_effects", plan)
    with pytest.raises(InputError, match=r"another configuration: queries\.spp"):
        generate(config, out)
    assert (out / "manifest.json").read_bytes() == content
    assert not contents(out)


def test_what_another_process_is_writing_is_not_replaced(
    config: GeneratorConfig, engine: Formula, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    generate(config, out)
    before = {p.name: p.read_bytes() for p in out.iterdir()}
    with shard_lock(out / FILES[1]) as held:
        assert held
        with pytest.raises(PartialError, match="is being written by another process"):
            generate(changed(config, seed=7), out, overwrite=True)
    assert {p.name: p.read_bytes() for p in out.iterdir()} == before
    assert generate(changed(config, seed=7), out, overwrite=True).complete


@pytest.mark.parametrize("count", [1, 2, 3, 5, 7])
def test_slices_share_the_work_without_gap_or_overlap(
    count: int, config: GeneratorConfig, engine: Formula, tmp_path: Path
) -> None:
    generate(config, tmp_path / "whole")
    engine.asked.clear()
    for index in range(1, count + 1):
        summary = generate(config, tmp_path / "out", slice_index=index, slice_count=count)
        assert summary.complete == (len(contents(tmp_path / "out")) == len(FILES))
    assert sorted(engine.asked) == [("test", 0), ("train", 0), ("train", 1), ("train", 2)]
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")
    assert finish(tmp_path / "out").complete


def test_a_shard_that_another_process_writes_is_left_to_it(
    config: GeneratorConfig, engine: Formula, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    engine.fail_at = 0
    with pytest.raises(KeyboardInterrupt):
        generate(config, out)
    engine.fail_at = None
    with shard_lock(out / FILES[1]) as held:
        assert held
        with pytest.raises(PartialError, match=FILES[1]):
            generate(config, out)
        assert sorted(contents(out)) == sorted(set(FILES) - {FILES[1]})
    assert generate(config, out).complete


def test_a_shard_that_was_finished_before_its_lock_was_had_is_not_made_again(
    config: GeneratorConfig, engine: Formula, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between the look at a shard and its lock another process may finish it and let go."""
    whole, out = tmp_path / "whole", tmp_path / "out"
    generate(config, whole)
    engine.asked.clear()
    take = shard_making.take_lock

    def late(path: Path) -> Any:
        if path.name == FILES[1]:
            for name in (path.name, sidecar_of(path).name):
                shutil.copy(whole / name, out / name)
        return take(path)

    monkeypatch.setattr(shard_making, "take_lock", late)
    assert generate(config, out).complete
    assert engine.asked == [("train", 0), ("train", 2), ("test", 0)]
    assert contents(out) == contents(whole)
    assert not list(out.glob(".*"))


def test_the_sidecar_says_what_the_shard_holds(
    config: GeneratorConfig, engine: Formula, tmp_path: Path
) -> None:
    generate(config, tmp_path / "out")
    record = json.loads((tmp_path / "out/train-00002.json").read_text())
    assert (record["rows"], record["queries"], record["paths"], record["spp"]) == (20, 20, 40, 2)
    assert record["seed"] == {"root": 0, "split": "train", "shard": 2}
    assert record["quarantined"] == {
        "nonfinite_samples": 1,
        "lost_rays": 1,
        "capped_rays": 2,
        "nonfinite_at": [{"query": 7, "effect": "direct light"}],
    }
    manifest = json.loads((tmp_path / "out/manifest.json").read_text())
    assert manifest["summary"]["nonfinite_samples"] == 4
    assert manifest["summary"]["paths"] == 320
    assert manifest["levels"]["mixture"] == {"log_uniform": 0.6, "finest": 0.4}
    assert manifest["splits"]["train"]["queries"] == 100
