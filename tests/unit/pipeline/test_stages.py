"""Stages run when, and only when, something they depend on has changed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mbtf_core.atomic import read_json
from mbtf_core.errors import InputError
from mbtf_pipeline.stages import (
    Decision,
    Outcome,
    Stage,
    decide,
    read_stamp,
    run_again,
    run_stages,
    stamp_path,
)

Config = dict[str, dict[str, Any]]


class Chain:
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

    def work(self, name: str) -> Callable[[Decision], dict[str, Any]]:
        def run(decision: Decision) -> dict[str, Any]:
            self.ran.append(name)
            self.decisions[name] = decision
            if name == self.fail_in:
                raise KeyboardInterrupt
            read = [self.file(n).read_text() for n in self.needs[name]]
            inputs = self.inputs if name == "generate" else {}
            self.file(name).write_text(f"{name} {self.config[name]} {inputs} of {read}")
            return {"note": name}

        return run

    def stages(self) -> list[Stage]:
        def outputs(name: str) -> Callable[[], list[Path]]:
            return lambda: [self.file(name)]

        return [
            Stage(
                name,
                needs,
                self.config[name],
                self.inputs if name == "generate" else {},
                outputs(name),
                self.work(name),
            )
            for name, needs in self.needs.items()
        ]

    def run(self, **options: Any) -> dict[str, Outcome]:
        self.ran, self.decisions = [], {}
        return run_stages(self.folder, self.stages(), **options)


@pytest.fixture
def chain(tmp_path: Path) -> Chain:
    chain = Chain(tmp_path)
    chain.run()
    assert chain.ran == list(Chain.needs)
    return chain


def test_nothing_runs_twice(chain: Chain) -> None:
    outcomes = chain.run()
    assert chain.ran == []
    assert not any(o.ran for o in outcomes.values())
    assert outcomes["compare"].stamp.notes == {"note": "compare"}


@pytest.mark.parametrize(
    ("stage", "expected"),
    [
        ("generate", ["generate", "fit a", "fit b", "compare", "report"]),
        ("fit b", ["fit b", "compare", "report"]),
        ("compare", ["compare", "report"]),
        ("report", ["report"]),
    ],
)
def test_a_changed_option_runs_its_stage_and_what_follows(
    chain: Chain, stage: str, expected: list[str]
) -> None:
    chain.config[stage] = {"option": 2}
    chain.run()
    assert chain.ran == expected
    assert "option: 1 -> 2" in chain.decisions[stage].reason
    chain.run()
    assert chain.ran == []


def test_a_changed_input_file_runs_everything(chain: Chain) -> None:
    chain.inputs = {"height": "digest 2"}
    chain.run()
    assert chain.ran == list(Chain.needs)
    assert "height" in chain.decisions["generate"].reason


@pytest.mark.parametrize("damage", ["missing", "changed"])
def test_a_damaged_output_runs_its_stage_and_what_follows(chain: Chain, damage: str) -> None:
    path = chain.file("fit a")
    if damage == "missing":
        path.unlink()
    else:
        path.write_text("something else")
    chain.run()
    # Its file comes out as before, yet what follows runs: the user sees it made from what is there now.
    assert chain.ran == ["fit a", "compare", "report"]
    assert chain.decisions["fit a"].damaged == (path,)
    assert "fit-a.txt" in chain.decisions["fit a"].reason
    assert chain.decisions["compare"].reason == "follows fit a"


def test_dates_and_names_of_folders_decide_nothing(chain: Chain, tmp_path: Path) -> None:
    for name in Chain.needs:
        chain.file(name).touch()
    moved = tmp_path.with_name(tmp_path.name + "-moved")
    tmp_path.rename(moved)
    chain.folder = moved
    chain.run()
    assert chain.ran == []


def test_an_interrupted_stage_has_not_run(chain: Chain) -> None:
    chain.config["compare"] = {"option": 2}
    chain.fail_in = "compare"
    with pytest.raises(KeyboardInterrupt):
        chain.run()
    assert read_stamp(chain.folder, "compare") is None
    # Even with its old options back, what an interrupted run may have left is not trusted.
    chain.config["compare"] = {"option": 1}
    chain.fail_in = ""
    chain.run()
    assert chain.ran == ["compare", "report"]


def test_force_runs_everything(chain: Chain) -> None:
    chain.run(force=True)
    assert chain.ran == list(Chain.needs)
    assert chain.decisions["generate"].forced


def test_order_of_options_does_not_count(chain: Chain) -> None:
    chain.config["compare"] = {"a": 1, "b": [2, 3]}
    chain.run()
    chain.config["compare"] = {"b": (2, 3), "a": 1}
    chain.run()
    assert chain.ran == []


def test_a_stamp_that_cannot_be_read_is_none(chain: Chain) -> None:
    path = stamp_path(chain.folder, "report")
    assert read_json(path)["outputs"].keys() == {"report.txt"}
    path.write_text("{")
    chain.run()
    assert chain.ran == ["report"]
    path.write_text('{"format": "mbtf-stage", "schema": 999}')
    chain.run()
    assert chain.ran == ["report"]


def test_deciding_changes_nothing(chain: Chain) -> None:
    chain.config["compare"] = {"option": 2}
    before = sorted(p.read_text() for p in chain.folder.rglob("*") if p.is_file())
    stage = chain.stages()[3]
    upstream = {n: read_stamp(chain.folder, n).outputs_hash for n in stage.needs}  # type: ignore[union-attr]
    assert decide(chain.folder, stage, upstream).runs
    assert sorted(p.read_text() for p in chain.folder.rglob("*") if p.is_file()) == before


def test_running_one_stage_again(chain: Chain) -> None:
    chain.ran = []
    run_again(chain.folder, chain.stages()[-1])
    assert chain.ran == ["report"]
    chain.run()
    assert chain.ran == []
    stamp_path(chain.folder, "fit b").unlink()
    with pytest.raises(InputError, match="fit b"):
        run_again(chain.folder, chain.stages()[-1])
