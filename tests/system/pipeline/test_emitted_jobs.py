"""Emitted job files, run by stand-ins of the schedulers: commands, order, failures, and names of paths."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from support.emitted import ALL, IMAGES, SLICES, TARGETS, emitted, kinds, make_place, start
from support.fake_cluster import calls, fail, install

from mbtf_core.config.settings import resolve
from mbtf_fit.cli.app import app as fit_app
from mbtf_fit.config import FitConfig
from mbtf_gen.cli.app import app as gen_app
from mbtf_gen.job import Job
from mbtf_pipeline.cli.app import app
from mbtf_pipeline.emit.jobs import Target
from mbtf_pipeline.recipe import Recipe, load_recipe
from mbtf_pipeline.run import data_sets


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = make_place(tmp_path)
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def recipe(place: Path) -> Recipe:
    return load_recipe(Path("recipe.yaml"))


@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize("outside", [False, True])
def test_all_commands_run_in_order_in_the_current_folder(
    recipe: Recipe, target: Target, outside: bool, place: Path, tmp_path: Path
) -> None:
    if outside and target == "k8s":
        pytest.skip("the volume holds the current folder")
    line = emitted(recipe, target, tmp_path / "jobs of $x" if outside else Path("my jobs"))
    done = start(line, install(tmp_path / "bin"))
    assert done.returncode == 0, done.stderr
    made = calls(tmp_path / "bin")
    order = kinds(tmp_path / "bin")
    assert sorted(order) == sorted(ALL)
    assert {call["cwd"] for call in made} == {str(place)}
    assert max(map(order.index, SLICES)) < order.index("mbtf-gen shards") < order.index("mbtf-fit neumip+")
    assert max(map(order.index, IMAGES)) < order.index("mbtf-gen shards-image")
    assert order.index("mbtf-gen shards-image") < order.index("mbtf-fit images")
    assert order[-1] == "mbtf-pipeline the $$run"


@pytest.mark.parametrize("target", TARGETS)
def test_commands_are_those_of_the_recipe(recipe: Recipe, target: Target, tmp_path: Path) -> None:
    """What a run finds in its folder is what it would have made itself."""
    assert start(emitted(recipe, target), install(tmp_path / "bin")).returncode == 0
    read: dict[str, Any] = {}
    programs = {"mbtf-gen": gen_app, "mbtf-fit": fit_app, "mbtf-pipeline": app}
    for words in (call["words"] for call in calls(tmp_path / "bin")):
        program = programs[words[0]]
        _, bound, _ = program.parse_args(words[1:], exit_on_error=False, print_error=False)
        options = bound.arguments.get("options")
        if options is not None:
            extra = {"material": None} if words[0] == "mbtf-gen" else {}
            read[words[words.index("-o") + 1]] = options.resolve(**extra)
    for data in data_sets(recipe):
        found = read[f"out/the $$run/{data.sub}"]
        assert Job.load(found).config_hash == Job.load(data.config).config_hash
    for name, config in recipe.fit.items():
        assert read[f"out/the $$run/fits/{name}"].fields() == config.fields()
    again = load_recipe(Path("my jobs/config/recipe.yaml"))
    assert Path(again.generate.material).samefile(recipe.generate.material)
    same = {"generate": {"material"}}
    assert again.model_dump(exclude=same) == recipe.model_dump(exclude=same)  # type: ignore[arg-type]
    assert resolve(FitConfig, file=Path("my jobs/config/fit-images.yaml")) == recipe.fit["images"]


def test_a_slice_that_is_unfinished_is_run_again(recipe: Recipe, tmp_path: Path) -> None:
    """Exit code 4: by SLURM and Kubernetes without anyone's help."""
    for target in ("slurm", "k8s"):
        folder = tmp_path / target
        environment = install(folder)
        fail(folder, "--slice 2/3", [4, 4])
        assert start(emitted(recipe, target, Path(target)), environment).returncode == 0  # type: ignore[arg-type]
        order = kinds(folder)
        assert order.count("shards 2/3") == 3
        assert order.count("shards 1/3") == 1
        assert order[-1] == "mbtf-pipeline the $$run"
    (log,) = Path("slurm/logs").glob("generate-[0-9]*-2.log")
    assert "slice 2/3 of generate: unfinished (exit code 4), queued again to resume" in log.read_text()


@pytest.mark.parametrize("target", TARGETS)
def test_a_failed_slice_is_named_and_a_second_start_finishes(
    recipe: Recipe, target: Target, tmp_path: Path
) -> None:
    line, environment = emitted(recipe, target), install(tmp_path / "bin")
    fail(tmp_path / "bin", "shards --slice 2/3", [3])
    done = start(line, environment)
    said = done.stderr
    if target == "slurm":
        # Its jobs fail after they were submitted.
        (log,) = Path("my jobs/logs").glob("generate-[0-9]*-2.log")
        said = log.read_text()
    else:
        assert done.returncode != 0
    name = "two-fits-generate" if target == "k8s" else "slice 2/3 of generate"
    assert "error: planted" in said
    assert f"{name} failed" in said
    assert "What is finished is kept; " in said
    assert line.removesuffix(" -j2") in said
    # Nothing that needs the slice has run.
    assert not {"mbtf-gen shards", "mbtf-fit neumip+", "mbtf-pipeline the $$run"} & set(
        kinds(tmp_path / "bin")
    )
    assert start(line, environment).returncode == 0
    assert set(kinds(tmp_path / "bin")) == ALL
    assert kinds(tmp_path / "bin")[-1] == "mbtf-pipeline the $$run"


@pytest.mark.parametrize(("target", "file"), [("slurm", "merge.sbatch"), ("k8s", "merge.yaml")])
def test_nothing_follows_a_job_that_is_refused(
    recipe: Recipe, target: Target, file: str, tmp_path: Path
) -> None:
    line, environment = emitted(recipe, target), install(tmp_path / "bin")
    fail(tmp_path / "bin", f"my jobs/{file}", [1])
    assert start(line, environment).returncode == 1
    assert not {"mbtf-gen shards", "mbtf-fit neumip+", "mbtf-pipeline the $$run"} & set(
        kinds(tmp_path / "bin")
    )


def test_slurm_gives_up_at_last(recipe: Recipe, tmp_path: Path) -> None:
    environment = install(tmp_path / "bin")
    fail(tmp_path / "bin", "shards --slice 2/3", [4] * 100)
    start(emitted(recipe, "slurm"), environment)
    assert kinds(tmp_path / "bin").count("shards 2/3") == 21
    (log,) = Path("my jobs/logs").glob("generate-[0-9]*-2.log")
    assert log.read_text().splitlines()[-1].startswith("slice 2/3 of generate failed with exit code 4")


def test_the_makefile_is_refused_elsewhere(recipe: Recipe, tmp_path: Path) -> None:
    emitted(recipe, "make")
    done = start("make -f 'my jobs/Makefile'", install(tmp_path / "bin"))
    assert done.returncode == 2
    assert "make -C FOLDER" in done.stderr


def test_a_job_that_slurm_stops_says_so(recipe: Recipe, tmp_path: Path) -> None:
    """SIGTERM comes from scancel, which means it, or before SLURM itself queues the job again."""
    environment = install(tmp_path / "bin")
    fail(tmp_path / "bin", "shards --slice 2/3", [143])
    start(emitted(recipe, "slurm"), environment)
    assert kinds(tmp_path / "bin").count("shards 2/3") == 1
    (log,) = Path("my jobs/logs").glob("generate-[0-9]*-2.log")
    said = log.read_text().splitlines()[-1]
    assert said.startswith("slice 2/3 of generate was stopped. What is finished is kept; ")
    assert said.endswith("resumes, unless SLURM starts it again itself")
