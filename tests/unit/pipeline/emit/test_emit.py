"""Emitted job files: their steps, resources and names; faults of the command line."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from support.emitted import RECIPE, REQUEST, make_place
from support.fake_cluster import read_job
from support.paths import ROOT

from mbtf_core.app.console import run
from mbtf_core.files.folders import owned
from mbtf_gen.cli.app import app as gen_app
from mbtf_gen.job import Job
from mbtf_pipeline.cli.app import app
from mbtf_pipeline.emit import jobs
from mbtf_pipeline.emit.jobs import emit_jobs
from mbtf_pipeline.emit.kubernetes import Cluster
from mbtf_pipeline.emit.places import Places
from mbtf_pipeline.emit.steps import Request, steps_of, waves
from mbtf_pipeline.forecast import RunForecast
from mbtf_pipeline.recipe import Recipe, load_recipe


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = make_place(tmp_path)
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def recipe(place: Path) -> Recipe:
    return load_recipe(Path("recipe.yaml"))


def test_slices_are_no_more_than_shards(recipe: Recipe) -> None:
    steps = steps_of(recipe, Path("run"), Path("jobs"), 100, REQUEST, None)
    slices = {step.name: step.slices for step in steps}
    assert slices["generate"] == len(Job.load(recipe.generate).shards) == 5
    assert {step.name: step.needs for step in steps} == {
        "generate": (),
        "merge": ("generate",),
        "generate-image": (),
        "merge-image": ("generate-image",),
        "fit-neumip+": ("merge",),
        "fit-images": ("merge-image",),
        "report": ("merge", "merge-image", "fit-neumip+", "fit-images"),
    }
    assert [[step.name for step in wave] for wave in waves(steps)] == [
        ["generate", "generate-image"],
        ["merge", "merge-image"],
        ["fit-neumip+", "fit-images"],
        ["report"],
    ]


def test_limits_follow_the_forecast(recipe: Recipe, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 16)
    expected = RunForecast(10.0, 7200.0, 600.0, 100.0, 60.0, 1, ())
    timed = load_recipe(
        Path("recipe.yaml"), ["fit.images.training.steps=null", "fit.images.training.time=1h"]
    )

    def limit(request: Request, slices: int) -> dict[str, float]:
        steps = steps_of(timed, Path("run"), Path("jobs"), slices, request, expected)
        return {step.name: step.resources.seconds for step in steps}

    # Eight cores need twice the time of sixteen; four times that, in tens of minutes.
    assert limit(Request(cpus=8), 1)["generate"] == pytest.approx(4 * 14400 + 600)
    assert limit(Request(cpus=16), 4)["generate"] == pytest.approx(4 * 1800 + 600)
    found = limit(Request(cpus=16), 4)
    assert found["merge"] == found["report"] == 1800
    assert found["fit-images"] == pytest.approx(4 * 3600 + 600)
    # Steps are not forecast.
    assert found["fit-neumip+"] == 4 * 3600
    assert set(limit(Request(seconds=700.0), 4).values()) == {700.0}
    little = steps_of(timed, Path("run"), Path("jobs"), 4, Request(memory=1e9), expected)
    assert {step.resources.memory for step in little} == {1e9}


def test_batch_scripts_state_their_resources(recipe: Recipe) -> None:
    request = Request(cpus=6, memory=4e9, seconds=5400.0, gpus=1)
    emit_jobs(recipe, Path("jobs"), ["slurm"], request=request)
    text = Path("jobs/generate.sbatch").read_text()
    for option in (
        "array=1-5",
        "cpus-per-task=6",
        "mem=3815M",
        "time=01:30:00",
        "requeue",
        "signal=B:USR1@90",
    ):
        assert f"#SBATCH --{option}\n" in text
    assert "gres" not in text
    assert "#SBATCH --gres=gpu:1\n" in Path("jobs/fit-images.sbatch").read_text()
    assert "array" not in Path("jobs/fit-images.sbatch").read_text()
    assert "#SBATCH --cpus-per-task=1\n" in Path("jobs/merge.sbatch").read_text()


def test_kubernetes_accepts_the_jobs(recipe: Recipe) -> None:
    reason = "no kubernetes-validate; to enable: pip install kubernetes-validate"
    validator = pytest.importorskip("kubernetes_validate", reason=reason)
    request = Request(seconds=5400.0, gpus=1)
    emit_jobs(recipe, Path("jobs"), ["k8s"], request=request, cluster=Cluster("registry/mbtf:1", "claim"))
    found = sorted(Path("jobs").glob("*.yaml"))
    assert len(found) == 7
    for path in found:
        job = read_job(path)
        validator.validate(job, "1.31", strict=True)
        job["spec"]["template"]["spec"]["restart"] = "Never"
        with pytest.raises(validator.ValidationError):
            validator.validate(job, "1.31", strict=True)


def test_pods_state_their_resources_and_are_restarted_but_for_bad_input(recipe: Recipe) -> None:
    request = Request(cpus=6, memory=4e9, seconds=5400.0, gpus=1)
    emit_jobs(recipe, Path("jobs"), ["k8s"], request=request, cluster=Cluster("registry/mbtf:1", "claim"))
    slices, fit = (read_job(Path("jobs") / name)["spec"] for name in ("generate.yaml", "fit-images.yaml"))
    assert (slices["completions"], slices["parallelism"], slices["completionMode"]) == (5, 5, "Indexed")
    # All slices share it.
    assert slices["backoffLimit"] == 5 * fit["backoffLimit"] > 0
    disrupted, final = slices["podFailurePolicy"]["rules"]
    assert disrupted["action"] == "Ignore"
    assert disrupted["onPodConditions"][0]["type"] == "DisruptionTarget"
    assert (final["action"], final["onExitCodes"]["values"]) == ("FailJob", [2, 3])
    pods = [spec["template"]["spec"] for spec in (slices, fit)]
    # At its limit a pod is replaced; that of a job would end it.
    assert [pod["activeDeadlineSeconds"] for pod in pods] == [5400, 5400]
    assert {pod["restartPolicy"] for pod in pods} == {"Never"}
    assert pods[0]["volumes"][0]["persistentVolumeClaim"] == {"claimName": "claim"}
    container, training = (pod["containers"][0] for pod in pods)
    assert container["image"] == "registry/mbtf:1"
    assert container["workingDir"] == container["volumeMounts"][0]["mountPath"]
    assert container["resources"] == {
        "requests": {"cpu": "6", "memory": "3815Mi"},
        "limits": {"memory": "3815Mi"},
    }
    assert training["resources"]["limits"]["nvidia.com/gpu"] == "1"
    # Signals reach the program, not a shell.
    assert container["command"][-1].startswith("exec mbtf-gen ")


def test_the_material_is_found_from_a_linked_folder(recipe: Recipe, tmp_path: Path) -> None:
    (tmp_path / "far" / "away").mkdir(parents=True)
    Path("jobs").symlink_to(tmp_path / "far" / "away")
    emit_jobs(recipe, Path("jobs"), ["make"], request=REQUEST)
    found = load_recipe(Path("jobs/config/recipe.yaml"))
    assert Path(found.generate.material).samefile(recipe.generate.material)
    assert (Path("jobs").resolve() / Places.of(Path("jobs")).up).samefile(Path())


STOPPED = """
source jobs/job.sh
export SLURM_JOB_ID=7
scontrol() { echo "$@" >> requeued; }
(sleep 0.2; kill -$0 $$) &
run_job test bash -c 'trap "sleep 0.2; touch stored; exit 143" TERM; while true; do sleep 0.05; done'
"""


@pytest.mark.parametrize("signal", ["USR1", "TERM"])
def test_a_job_that_is_stopped_stores_its_work(recipe: Recipe, signal: str) -> None:
    """It is queued again near its limit, but not by scancel."""
    emit_jobs(recipe, Path("jobs"), ["slurm"], request=REQUEST)
    done = subprocess.run(["bash", "-c", STOPPED, signal], capture_output=True, check=False, timeout=10)
    assert done.returncode == 143
    assert Path("stored").exists()
    assert Path("requeued").exists() == (signal == "USR1")


def test_names_of_kubernetes_jobs_are_valid_and_differ(place: Path) -> None:
    names = ["neumip", "Neumip", "neumip+", "n" * 100]
    text = RECIPE.partition("fit:")[0] + "fit:\n" + "".join(f"  {n}: {{model: neumip}}\n" for n in names)
    (place / "recipe.yaml").write_text(text)
    recipe = load_recipe(Path("recipe.yaml"))
    emit_jobs(recipe, Path("jobs"), ["k8s"], request=REQUEST, cluster=Cluster("mbtf"))
    found = [read_job(p)["metadata"]["name"] for p in Path("jobs").glob("*.yaml")]
    assert len(set(found)) == 3 + len(names)
    assert all(re.fullmatch(r"[a-z0-9]([-a-z0-9]{0,51}[a-z0-9])?", name) for name in found)


def test_timed_fits_run_one_after_another_by_make(recipe: Recipe) -> None:
    def prerequisites(recipe: Recipe) -> str:
        emit_jobs(recipe, Path("jobs"), ["make"], request=REQUEST, overwrite=True)
        lines = Path("jobs/Makefile").read_text().splitlines()
        return next(line for line in lines if line.startswith("fit-images:"))

    assert prerequisites(recipe) == "fit-images: merge-image"
    timed = load_recipe(Path("recipe.yaml"), ["fit.images.training.steps=null"])
    assert prerequisites(timed) == "fit-images: merge-image | fit-neumip+"


def emit(*words: str) -> int:
    return run(app, ["emit", "recipe.yaml", *words])


def test_faults_of_the_command_line(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def said() -> str:
        return capsys.readouterr().err

    assert emit() == 2
    assert "--to slurm" in said()
    assert emit("--to", "k8s") == 2
    assert said().startswith("error: --image: is missing")
    assert emit("--to", "make", "--image", "x") == 2
    assert "add --to k8s" in said()
    assert emit("--to", "make", "--job-memory", "much") == 2
    assert said().startswith("error: --job-memory: ")
    assert emit("--to", "make", "--slices", "0") == 2
    assert emit("--to", "slurm", "--time-limit", "1min") == 2
    assert "5min or more" in capsys.readouterr().err
    assert emit("--to", "slurm", "--time-limit", "1h", "-o", "50%") == 2
    assert "% in the names" in said()
    assert emit("--to", "make", "--time-limit", "1h", "-o", "two\nlines") == 2
    assert "cannot name it" in said()
    assert emit("--to", "k8s", "--image", "x", "--time-limit", "1h", "-o", str(tmp_path / "jobs")) == 2
    assert "outside the current folder" in said()
    away = tmp_path / "away.npy"
    shutil.copy(next((place / "the maps").iterdir()), away)
    for assigned in (
        [f"generate.material={away}"],
        ["fit.images.model=neumip", f"fit.images.decoder={away}"],
    ):
        options = [word for text in assigned for word in ("--set", text)]
        assert emit("--to", "k8s", "--image", "x", "--time-limit", "1h", *options) == 2
        assert said().startswith(f"error: {away}: lies outside")
    # Nothing was written.
    assert sorted(path.name for path in place.iterdir()) == ["recipe.yaml", "the maps"]
    for name in ("paper_methods", "library"):
        path = ROOT / "pipelines" / f"{name}.yaml"
        assert run(app, ["emit", str(path), "--to", "make"]) == 2
        assert said().startswith(f"error: {path}: has several runs")


def test_other_job_files_are_replaced_on_demand(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("--to", "make", "--time-limit", "1h", "--json")
    assert emit(*words) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["start"] == {"make": "make -C jobs -j2"}
    assert data["steps"][0]["name"] == "generate"
    assert all((place / "jobs" / name).is_file() for name in data["files"])
    # The same again changes nothing.
    assert emit(*words) == 0
    assert emit(*words, "--slices", "2") == 3
    assert "holds other job files: Makefile" in capsys.readouterr().err
    assert "generate-3" in (place / "jobs" / "Makefile").read_text()
    assert emit("--to", "slurm", "--time-limit", "1h", "--overwrite") == 0
    assert not (place / "jobs" / "Makefile").exists()
    assert emit("--to", "make", "--time-limit", "1h", "-o", "the maps") == 3
    assert "holds no job files" in capsys.readouterr().err


def test_folders_of_others_are_refused_before_the_forecast(
    place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def forecast(recipe: Recipe) -> RunForecast:
        raise AssertionError

    monkeypatch.setattr(jobs, "forecast_run", forecast)
    assert emit("--to", "make", "-o", "the maps") == 3
    assert "holds no job files" in capsys.readouterr().err
    assert emit("--to", "make", "--run-folder", "the maps") == 3
    assert "--run-folder" in capsys.readouterr().err
    # A lock in a run's folder: a run goes on there.
    with owned(place / "run"):
        assert emit("--to", "make", "--run-folder", "run", "--time-limit", "1h") == 4
    assert "--run-folder" in capsys.readouterr().err


def test_data_of_another_configuration_is_refused(
    recipe: Recipe, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The jobs would refuse it too, but late."""
    shards = "out/Two_fits/shards"
    assert run(gen_app, [recipe.generate.material, "-o", shards, "--queries", "10", "-q"]) == 0
    capsys.readouterr()
    words = ("--to", "make", "--time-limit", "1h")
    assert emit(*words) == 3
    assert f"{shards}: is of another configuration" in capsys.readouterr().err
    assert emit(*words, "--run-folder", "out/other") == 0
    fit = place / "out/other/fits/images"
    fit.mkdir(parents=True)
    (fit / "fit.json").write_text('{"config": {}}')
    assert emit(*words, "--run-folder", "out/other") == 3
    assert "fits/images: is of another configuration" in capsys.readouterr().err
