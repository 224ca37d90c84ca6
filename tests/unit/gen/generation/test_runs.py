"""Generating a data set without tracing: folders, resuming, summaries."""

from __future__ import annotations

import contextlib
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.datasets import formula
from support.formula_runs import Formula, changed, contents, listing

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.geometry import Geometry
from mbtf_core.data.shard_files import read_shard
from mbtf_core.data.verify import verify
from mbtf_core.errors import InputError, PartialError
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.engine.runtime import load_mitsuba
from mbtf_gen.generation import folder
from mbtf_gen.generation import repair as repairs
from mbtf_gen.generation import run as generation
from mbtf_gen.generation.run import generate
from mbtf_gen.generation.shard_record import ShardStatistics
from mbtf_gen.planning.effects_plan import EffectsPlan
from mbtf_gen.planning.job import Job
from mbtf_gen.planning.simulation import geometry_of

load_mitsuba()

from mbtf_core.data.documents import BadSample  # noqa: E402

pytestmark = pytest.mark.usefixtures("engine")


def test_a_run_is_complete_and_counts(config: GeneratorConfig, out: Path) -> None:
    seen: list[float] = []
    summary = generate(config, out, progress=lambda done, note, total: seen.append(done))
    # Progress counts paths: a test query takes twice as many as a training query.
    assert seen == [0, 0, 80, 160, 200, 320]
    assert (summary.complete, summary.queries, summary.paths) == (True, 130, 100 * 2 + 30 * 4)
    assert summary.splits == {"train": 100, "test": 30}
    assert (summary.lost, summary.capped, summary.nonfinite) == (4, 8, 4)
    assert summary.relative_error == 0.0
    data = Dataset.open(out).load("train")
    np.testing.assert_allclose(summary.mean_value, data["value_a"].astype(np.float64).mean(axis=0), rtol=1e-6)
    assert set(data["spp"]) == {2.0}
    assert verify(out) == []
    assert not list(out.glob(".*"))


def test_queries_that_share_paths_are_stored_as_the_manifest_says(
    config: GeneratorConfig, engine: Formula, out: Path
) -> None:
    generate(changed(config, queries={"lights_per_path": 3}), out)
    assert {lights for split, lights in engine.lights if split == "train"} == {3}
    assert {lights for split, lights in engine.lights if split == "test"} == {1}
    data = Dataset.open(out)
    assert (data.lights_per_path("train"), data.lights_per_path("test")) == (3, 1)
    for shard in data.shards("train"):
        arrays = shard.read()
        for name in ("u", "sigma", "omega_o", "spp"):
            groups = arrays[name].reshape(3, shard.rows // 3, -1)
            assert (groups == groups[0]).all()
        assert len(np.unique(arrays["omega_i"], axis=0)) == shard.rows
    assert verify(out) == []


@pytest.mark.parametrize("layout", ["shuffled", "image"])
def test_shards_hold_what_was_drawn_and_estimated(
    config: GeneratorConfig, engine: Formula, tmp_path: Path, layout: str
) -> None:
    engine.bad = ()
    job = Job.load(changed(config, queries={"layout": layout}))
    generate(job, tmp_path / "out")
    for entry in job.shards:
        drawn = job.query_plan.draw(entry.split, entry.index, entry.rows)
        value = formula(drawn.flat()).astype(np.float32).reshape(*drawn.lead, 3)
        stored = read_shard(tmp_path / "out" / entry.file)
        expected = {**vars(drawn), "value_a": value, "value_b": value}
        for name, array in expected.items():
            np.testing.assert_array_equal(stored[name], array, err_msg=name)


def test_too_many_nonfinite_samples_fail_the_run(config: GeneratorConfig, engine: Formula, out: Path) -> None:
    """Two per shard: any run may have four, but not six."""
    engine.bad = (BadSample(7, "direct light"), BadSample(9, "interreflection"))
    place = "train-00000.npz query 7, direct light; train-00000.npz query 9, interreflection"
    with pytest.raises(PartialError, match=f"6 of 320 samples were NaN or infinite.*{place}"):
        generate(config, out)
    with pytest.raises(PartialError, match=f"8 of 320 samples.*{place}"):
        generate(config, out)
    assert not json.loads((out / "manifest.json").read_text())["complete"]


@pytest.mark.parametrize(
    ("count", "paths", "refused"), [(4, 1, False), (5, 4_999_999, True), (5, 5_000_000, False)]
)
def test_one_sample_in_a_million_may_be_nonfinite(count: int, paths: int, refused: bool) -> None:
    statistics = ShardStatistics()
    statistics.counts["nonfinite_samples"] = count
    with pytest.raises(PartialError) if refused else contextlib.nullcontext():
        statistics.refuse_nonfinite(paths, "out")


def test_a_finished_run_renders_nothing(
    config: GeneratorConfig, monkeypatch: pytest.MonkeyPatch, out: Path
) -> None:
    first = generate(config, out)
    before = {p.name: (p.stat().st_mtime_ns, p.read_bytes()) for p in out.iterdir()}
    # Nothing is missing, so no estimator is built.
    monkeypatch.setattr(generation, "build_estimator", None)
    second = generate(config, out)
    assert (second.paths, second.complete, second.mean_value) == (0, True, first.mean_value)
    assert before == {p.name: (p.stat().st_mtime_ns, p.read_bytes()) for p in out.iterdir()}


def test_a_shard_of_another_run_is_not_overwritten(config: GeneratorConfig, out: Path) -> None:
    generate(config, out)
    generate(changed(config, light={"width": 2.0}), out.with_name("other"))
    for name in ("train-00000.npz", "train-00000.json"):
        (out / name).write_bytes((out.with_name("other") / name).read_bytes())
    before = listing(out)
    with pytest.raises(InputError, match="train-00000 belongs to another data set"):
        generate(config, out)
    assert listing(out) == before


def test_a_geometry_of_another_machine_is_not_mixed_in(
    config: GeneratorConfig, monkeypatch: pytest.MonkeyPatch, out: Path
) -> None:
    """Its heights differ by rounding, and its digest from the manifest's."""
    generate(config, out)
    (out / "geometry.exr").unlink()
    before = listing(out)

    def rounded(job: Job, plan: EffectsPlan) -> Geometry:
        found = geometry_of(job, plan)
        return replace(found, slopes=np.nextafter(found.slopes, np.float32(9)))

    with monkeypatch.context() as patch:
        for module in (folder, repairs):
            patch.setattr(module, "geometry_of", rounded)
        for act in (lambda: generate(config, out), lambda: repairs.repair(out)):
            with pytest.raises(InputError, match="this machine computes it differently"):
                act()
            assert listing(out) == before
    assert repairs.repair(out).documents == ["geometry.exr"]
    assert verify(out) == []


def test_another_configuration_is_refused_field_by_field(
    config: GeneratorConfig, tmp_path: Path, out: Path
) -> None:
    generate(config, out)
    before = listing(out)
    other = changed(config, queries={"spp": 8, "min_cos": 0.2}, light={"width": 3.0})
    with pytest.raises(InputError) as caught:
        generate(other, out)
    for part in ("light.width: 1.0 -> 3.0", "queries.min_cos: 0.1 -> 0.2", "queries.spp: 2 -> 8"):
        assert part in caught.value.what
    assert "--overwrite" in caught.value.hint
    np.save(tmp_path / "height.npy", np.zeros((4, 8)))
    with pytest.raises(InputError, match=r"inputs\.height"):
        generate(config, out)
    assert before == listing(out)


def test_overwrite_replaces_only_the_data_set(config: GeneratorConfig, out: Path) -> None:
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


def test_an_interrupted_overwrite_can_be_repeated(
    config: GeneratorConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, out: Path
) -> None:
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
        {"notes.txt": "mine", "config.yaml": "mine"},
        {"manifest.json": '{"name": "a web page"}', ".env": "mine", "train-1.png": "mine"},
        {"manifest.json": "{"},
        {"train-00000.npz": "an orphan"},
    ],
    ids=["notes", "foreign manifest", "broken manifest", "orphan"],
)
def test_foreign_folders_are_refused_untouched(
    files: dict[str, str], overwrite: bool, config: GeneratorConfig, out: Path
) -> None:
    out.mkdir()
    for name, text in files.items():
        (out / name).write_text(text)
    with pytest.raises(InputError):
        generate(config, out, overwrite=overwrite)
    assert {p.name: p.read_text() for p in out.iterdir()} == files
