"""Data sets generated on a cluster: the bits of a plain run, whoever dies meanwhile."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.commands import Done, run_named
from support.small_runs import contents, write_maps

from mbtf_core.data.verify import verify

pytest.importorskip("distributed", reason="no Dask; to enable: pip install 'mbtf[cluster]'")

SMALL = "maps --test-queries 200 --test-spp 8 --set output.shard_queries=128"
COUNTS = {
    "allocated": f"{SMALL} --queries 16/texel",
    "fixed": f"{SMALL} --queries 16/texel --set queries.allocation=uniform",
    "adaptive": f"{SMALL} --queries 4/texel --target-error 20%",
    "images": f"{SMALL} --queries 8/texel --layout image",
}


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    """Address of a scheduler with two workers, as a user may have started it."""
    from distributed import LocalCluster

    with LocalCluster(2, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0") as cluster:
        yield cluster.scheduler_address


@pytest.fixture(scope="module")
def runs(scheduler: str, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Done]]:
    """Every kind of counts, by one process and by the cluster, in folders of their names."""
    folder = tmp_path_factory.mktemp("cluster")
    write_maps(folder)
    lines = {}
    for name, line in COUNTS.items():
        lines[name] = f"{line} -o {name} --json"
        lines[f"{name}-cluster"] = f"{line} -o {name}-cluster --json --cluster {scheduler}"
    again = "fixed-cluster"
    lines["again"] = f"{COUNTS['fixed']} -o {again} --json --cluster tcp://127.0.0.1:9"
    pictures = "maps --size 24 --spp 8 --tiles-across 1,2 --kind both --json"
    lines["pictures"] = f"reference {pictures} -o pictures"
    lines["pictures-cluster"] = f"reference {pictures} -o pictures-cluster --cluster {scheduler}"
    lines["local"] = f"{COUNTS['allocated']} -o local --json --cluster local:2"
    return folder, run_named(lines, folder)


@pytest.mark.parametrize("name", COUNTS)
def test_values_are_those_of_one_process(name: str, runs: tuple[Path, dict[str, Done]]) -> None:
    folder, done = runs
    own, clustered = done[name].result(), done[f"{name}-cluster"].result()
    assert clustered["complete"]
    assert clustered["paths"] == own["paths"] > 0
    assert clustered["mean_value"] == own["mean_value"]
    assert contents(folder / f"{name}-cluster") == contents(folder / name)
    assert "2 workers" in done[f"{name}-cluster"].err


def test_workers_of_its_own(runs: tuple[Path, dict[str, Done]]) -> None:
    folder, done = runs
    assert done["local"].result()["complete"]
    assert contents(folder / "local") == contents(folder / "allocated")


def test_reference_pictures_are_those_of_one_process(runs: tuple[Path, dict[str, Done]]) -> None:
    folder, done = runs
    own, clustered = done["pictures"].result(), done["pictures-cluster"].result()
    assert len(own["pictures"]) == 4
    assert clustered["exposure"] == own["exposure"]
    for name in [Path(picture["file"]).stem for picture in own["pictures"]]:
        for suffix in ("exr", "png"):
            files = [folder / kind / f"{name}.{suffix}" for kind in ("pictures", "pictures-cluster")]
            assert files[0].read_bytes() == files[1].read_bytes()


def test_a_finished_data_set_needs_no_cluster(runs: tuple[Path, dict[str, Done]]) -> None:
    assert runs[1]["again"].result()["paths"] == 0


def is_worker(process: Any) -> bool:
    """Whether a child of a command is a worker that lives."""
    import psutil

    try:
        return process.status() != psutil.STATUS_ZOMBIE and "spawn_main" in " ".join(process.cmdline())
    except psutil.Error:
        return False


@pytest.mark.parametrize("kills", [2, pytest.param(100, marks=[pytest.mark.slow, pytest.mark.timeout(3600)])])
def test_killed_workers_and_commands_lose_nothing(kills: int, tmp_path: Path) -> None:
    import psutil

    write_maps(tmp_path)
    shards = 12 * kills
    line = f"maps --queries {shards * 4096} --test-queries 4096 --spp 64 --test-spp 64"
    line += " --set output.shard_queries=4096 -q -o"
    command = [sys.executable, "-m", "mbtf_gen", *line.split()]
    done = subprocess.run([*command, "whole"], cwd=tmp_path, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    random = np.random.default_rng(kills)
    driver: psutil.Popen | None = None
    killed = {"command": 0, "worker": 0}
    while sum(killed.values()) < kills:
        if driver is None or driver.poll() is not None:
            assert driver is None or driver.returncode in (0, 4, -signal.SIGKILL)
            if driver is not None and driver.returncode == 0:
                break
            driver = psutil.Popen([*command, "out", "--cluster", "local:2"], cwd=tmp_path)
            ready = len(list(tmp_path.glob("out/*.json")))
            # At least one more shard in every run, so that the test ends.
            while driver.poll() is None and len(list(tmp_path.glob("out/*.json"))) <= ready + 1:
                time.sleep(0.05)
            continue
        time.sleep(random.exponential(0.5))
        workers = [child for child in driver.children(recursive=True) if is_worker(child)]
        kind = "command" if not workers or random.random() < 0.2 else "worker"
        victim = driver if kind == "command" else workers[random.integers(len(workers))]
        victim.kill()
        killed[kind] += 1
        if kind == "command":
            driver.wait()
    while driver is None or driver.wait() != 0:
        driver = psutil.Popen([*command, "out", "--cluster", "local:2"], cwd=tmp_path)
    assert sum(killed.values()) > kills // 2
    assert killed["worker"] > 0
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")
    assert verify(tmp_path / "out") == []
