"""Stages run if, and only if, something they depend on has changed."""

from __future__ import annotations

import signal
import threading
from pathlib import Path
from typing import Any

import pytest

from mbtf_core.errors import InputError
from mbtf_core.files.atomic import read_json
from mbtf_pipeline.stages import (
    Decision,
    Stage,
    StageResult,
    read_stamp,
    run_stages,
    stamp_path,
)

Config = dict[str, dict[str, Any]]


class Pipeline:
    """generate → fit a, fit b → compare → report, each writing its config and what it read into one file."""

    needs: dict[str, tuple[str, ...]] = {  # noqa: RUF012
        "generate": (),
        "fit a": ("generate",),
        "fit b": ("generate",),
        "compare": ("generate", "fit a", "fit b"),
        "report": ("generate", "fit a", "fit b", "compare"),
    }

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.config: Config = {name: {"option": 1} for name in self.needs}
        self.inputs = {"height": "digest 1"}
        self.ran: list[str] = []
        self.decisions: dict[str, Decision] = {}
        self.fail_in = ""

    def file(self, name: str) -> Path:
        return self.folder / f"{name.replace(' ', '-')}.txt"

    def stage(self, name: str) -> Stage:
        inputs = {} if self.needs[name] else self.inputs

        def work(decision: Decision) -> None:
            self.ran.append(name)
            self.decisions[name] = decision
            if name == self.fail_in:
                raise KeyboardInterrupt
            read = [self.file(n).read_text() for n in self.needs[name]]
            self.file(name).write_text(f"{name} {self.config[name]} {inputs} of {read}")

        return Stage(name, self.needs[name], self.config[name], inputs, (self.file(name).name,), work)

    def stages(self) -> list[Stage]:
        return [self.stage(name) for name in self.needs]

    def run(self, **options: Any) -> dict[str, StageResult]:
        self.ran, self.decisions = [], {}
        return run_stages(self.folder, self.stages(), **options)


@pytest.fixture
def pipeline(tmp_path: Path) -> Pipeline:
    pipeline = Pipeline(tmp_path)
    pipeline.run()
    assert pipeline.ran == list(Pipeline.needs)
    return pipeline


@pytest.mark.parametrize(
    ("stage", "expected"),
    [
        ("generate", ["generate", "fit a", "fit b", "compare", "report"]),
        ("fit b", ["fit b", "compare", "report"]),
        ("report", ["report"]),
    ],
)
def test_changed_options_run_later_stages(pipeline: Pipeline, stage: str, expected: list[str]) -> None:
    pipeline.config[stage] = {"option": 2}
    pipeline.run()
    assert pipeline.ran == expected
    assert "option: 1 -> 2" in pipeline.decisions[stage].reason
    pipeline.run()
    assert pipeline.ran == []


def test_what_an_earlier_command_made_anew_runs_later_stages(pipeline: Pipeline) -> None:
    """It ran the first stage alone, or was interrupted between two stages."""
    pipeline.config["generate"] = {"option": 2}
    run_stages(pipeline.folder, pipeline.stages()[:1])
    pipeline.run()
    assert pipeline.ran == ["fit a", "fit b", "compare", "report"]
    assert pipeline.decisions["fit a"].reason == "inputs changed: generate"


def test_a_changed_input_file_runs_everything(pipeline: Pipeline) -> None:
    pipeline.inputs = {"height": "digest 2"}
    pipeline.run()
    assert pipeline.ran == list(Pipeline.needs)
    assert "height" in pipeline.decisions["generate"].reason


@pytest.mark.parametrize("damage", ["missing", "changed"])
def test_a_changed_output_runs_its_stage_and_later_ones(pipeline: Pipeline, damage: str) -> None:
    path = pipeline.file("fit a")
    if damage == "missing":
        path.unlink()
    else:
        path.write_text("something else")
    pipeline.run()
    # Later stages run although the recreated file is identical.
    assert pipeline.ran == ["fit a", "compare", "report"]
    assert pipeline.decisions["fit a"].changed_files == (path,)
    assert "fit-a.txt" in pipeline.decisions["fit a"].reason
    assert pipeline.decisions["compare"].reason == "follows fit a"


def test_an_edited_document_is_replaced_if_forced_only(
    pipeline: Pipeline, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where its stage must run for another reason."""
    monkeypatch.setattr("mbtf_pipeline.stages.DOCUMENTS", (".txt",))
    pipeline.run()
    path = pipeline.file("report")
    path.write_text("my own words")
    for option in (1, 2):
        pipeline.config["report"] = {"option": option}
        with pytest.raises(InputError, match=r"report\.txt: has been edited"):
            pipeline.run()
        assert path.read_text() == "my own words"
    run_stages(pipeline.folder, pipeline.stages(), force=True)
    assert path.read_text() != "my own words"


def test_dates_and_folder_names_do_not_matter(pipeline: Pipeline, tmp_path: Path) -> None:
    for name in Pipeline.needs:
        pipeline.file(name).touch()
    moved = tmp_path.with_name(tmp_path.name + "-moved")
    tmp_path.rename(moved)
    pipeline.folder = moved
    pipeline.run()
    assert pipeline.ran == []


def test_an_interrupted_stage_has_not_run(pipeline: Pipeline) -> None:
    pipeline.config["compare"] = {"option": 2}
    pipeline.fail_in = "compare"
    with pytest.raises(KeyboardInterrupt):
        pipeline.run()
    assert read_stamp(pipeline.folder, "compare") is None
    # With the old options, outputs of an interrupted run are not trusted either.
    pipeline.config["compare"] = {"option": 1}
    pipeline.fail_in = ""
    pipeline.run()
    assert pipeline.ran == ["compare", "report"]


def test_an_unreadable_stamp_is_ignored(pipeline: Pipeline) -> None:
    path = stamp_path(pipeline.folder, "report")
    assert read_json(path)["outputs"].keys() == {"report.txt"}
    for text in ("{", '{"format": "mbtf-stage", "schema": 999}'):
        path.write_text(text)
        pipeline.run()
        assert pipeline.ran == ["report"]


def test_an_interruption_does_not_wait_for_other_machines(tmp_path: Path) -> None:
    begun, ended, main = threading.Barrier(2), threading.Event(), threading.get_ident()

    def work(decision: Decision) -> None:
        if begun.wait(60.0) == 0:
            signal.pthread_kill(main, signal.SIGINT)
        ended.wait(60.0)

    stages = [Stage(f"fit {n}", (), {}, {}, (), work, remote=True) for n in "ab"]
    try:
        with pytest.raises(KeyboardInterrupt):
            run_stages(tmp_path, stages)
        # Its threads still wait.
        assert any(thread.name.startswith("stages") for thread in threading.enumerate())
    finally:
        ended.set()
