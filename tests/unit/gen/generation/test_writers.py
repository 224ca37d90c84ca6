"""Several writers of one data set: slices, locks, and runs at the same time."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
from support.formula_runs import FILES, Formula, changed, cheap_plan, contents, listing

from mbtf_core.data.folder import DataFolder
from mbtf_core.data.geometry import geometry_record
from mbtf_core.data.verify import verify
from mbtf_core.errors import InputError, PartialError
from mbtf_core.files.atomic import checksummed, create_file
from mbtf_core.files.locks import shard_lock, take_lock
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.engine.runtime import load_mitsuba
from mbtf_gen.generation import run as generation
from mbtf_gen.generation.manifest import build_manifest, finish
from mbtf_gen.generation.run import generate
from mbtf_gen.planning.job import Job
from mbtf_gen.planning.run_plan import RunPlan, reference_plan
from mbtf_gen.planning.simulation import geometry_of

load_mitsuba()

pytestmark = pytest.mark.usefixtures("engine")


def write_while_planning(patch: pytest.MonkeyPatch, out: Path, job: Job, plan: RunPlan) -> bytes:
    """Let another process write this manifest while the next run plans."""
    record = geometry_record(geometry_of(job, plan.effects))
    content = checksummed(build_manifest(job, plan, record))

    def plan_run(job: Job, note: Any) -> RunPlan:
        out.mkdir()
        assert create_file(out / "manifest.json", content)
        return cheap_plan(job)

    patch.setattr(generation, "plan_run", plan_run)
    return content


def test_the_second_writer_adopts_the_plan_of_the_first(
    config: GeneratorConfig, monkeypatch: pytest.MonkeyPatch, out: Path
) -> None:
    job = Job.load(config)
    other = RunPlan(dataclasses.replace(reference_plan(job), cap_bias_bound=0.125))
    write_while_planning(monkeypatch, out, job, other)
    assert generate(config, out).complete
    assert json.loads((out / "manifest.json").read_text())["effects"] == other.effects.to_manifest()
    assert other != cheap_plan(job)
    assert verify(out) == []


def test_the_unfinished_geometry_of_another_writer_is_left_alone(config: GeneratorConfig, out: Path) -> None:
    """The lock of the manifest protects it."""
    generate(config, out)
    unfinished = out / ".geometry.exr.0123abcd-99999999.tmp"
    unfinished.write_bytes(b"half")
    with shard_lock(out / "manifest.npz") as held:
        assert held
        DataFolder.open(out).remove_leftovers()
        assert unfinished.exists()
    DataFolder.open(out).remove_leftovers()
    assert not unfinished.exists()


def test_a_concurrent_writer_of_another_data_set_is_refused(
    config: GeneratorConfig, monkeypatch: pytest.MonkeyPatch, out: Path
) -> None:
    another = Job.load(changed(config, queries={"spp": 8}))
    content = write_while_planning(monkeypatch, out, another, cheap_plan(another))
    with pytest.raises(InputError, match=r"another configuration: queries\.spp"):
        generate(config, out)
    assert (out / "manifest.json").read_bytes() == content
    assert not contents(out)


def test_a_data_set_being_written_is_not_replaced(config: GeneratorConfig, out: Path) -> None:
    generate(config, out)
    before = listing(out)
    with shard_lock(out / FILES[1]) as held:
        assert held
        with pytest.raises(PartialError, match="is being written by another process"):
            generate(changed(config, seed=7), out, overwrite=True)
    assert listing(out) == before
    assert generate(changed(config, seed=7), out, overwrite=True).complete


@pytest.mark.parametrize("count", [2, 5])
def test_slices_cover_every_shard_once(
    count: int, config: GeneratorConfig, engine: Formula, tmp_path: Path, out: Path
) -> None:
    generate(config, tmp_path / "whole")
    engine.estimated.clear()
    for index in range(1, count + 1):
        # What other slices have begun is kept.
        summary = generate(config, out, slice_index=index, slice_count=count, overwrite=True)
        assert summary.complete == (len(contents(out)) == len(FILES))
    assert sorted(engine.estimated) == [("test", 0), ("train", 0), ("train", 1), ("train", 2)]
    assert contents(out) == contents(tmp_path / "whole")
    assert finish(out).complete


def test_a_locked_shard_is_left_to_its_writer(config: GeneratorConfig, engine: Formula, out: Path) -> None:
    engine.fail_at = 0
    with pytest.raises(KeyboardInterrupt):
        generate(config, out)
    engine.fail_at = None
    with shard_lock(out / FILES[1]) as held:
        assert held
        with pytest.raises(PartialError, match=rf"{FILES[1]} \(process {os.getpid()} on .*, for \d+ s\)"):
            generate(config, out)
        assert sorted(contents(out)) == sorted(set(FILES) - {FILES[1]})
    assert generate(config, out).complete


@pytest.mark.parametrize("finished", [True, False])
def test_the_run_that_ends_last_finishes_the_data_set(
    finished: bool,
    config: GeneratorConfig,
    engine: Formula,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    out: Path,
) -> None:
    """Another process renders a shard at first; it finishes it, or ends without."""
    whole = tmp_path / "whole"
    generate(config, whole)
    engine.estimated.clear()
    out.mkdir()
    lock = take_lock(out / FILES[1])
    estimate = engine.estimate

    def meanwhile(queries: Any, spp: int, stream: Any, **_: Any) -> Any:
        if stream.split == "test":
            for path in (out / FILES[1], (out / FILES[1]).with_suffix(".json")) if finished else ():
                shutil.copy(whole / path.name, path)
            lock.release()
        return estimate(queries, spp, stream)

    monkeypatch.setattr(engine, "estimate", meanwhile)
    assert generate(config, out).complete
    assert engine.estimated == [("train", 0), ("train", 2), ("test", 0), *[("train", 1)] * (not finished)]
    assert contents(out) == contents(whole)
    assert not list(out.glob(".*"))
