"""``examples/slurm_array.sh`` on a real SLURM: the bytes of a plain run. It needs root and Debian's packages
slurm-wlm and munge."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from support.paths import ROOT
from support.small_runs import contents, write_maps

SLURM = ROOT / "tests" / "system" / "slurm"
OPTIONS = "--queries 16/texel --test-queries 200 --test-spp 8 --set output.shard_queries=128"


@contextmanager
def slurm_node(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A SLURM of one node, which the environment names, for a block; skips where it cannot be."""
    missing = [name for name in ("slurmctld", "slurmd", "munged") if shutil.which(name) is None]
    if missing:
        pytest.skip(f"no {missing[0]}; to enable, on Debian: apt install slurm-wlm munge")
    if os.geteuid() != 0:
        pytest.skip("not root, as which SLURM runs; to enable: run the tests as root")
    # Names of sockets are short.
    folder = Path(tempfile.mkdtemp(prefix="slurm-", dir="/tmp"))
    try:
        done = subprocess.run(
            [SLURM / "start.sh", folder, "2"], capture_output=True, text=True, timeout=60, check=False
        )
        assert done.returncode == 0, done.stderr
        monkeypatch.setenv("SLURM_CONF", str(folder / "slurm.conf"))
        yield
    finally:
        subprocess.run([SLURM / "stop.sh", folder], capture_output=True, timeout=60, check=False)
        shutil.rmtree(folder, ignore_errors=True)


def install_programs(folder: Path) -> None:
    """Make the programs' commands in a folder; a fit takes a moment."""
    folder.mkdir()
    for name, options in (
        ("mbtf-gen", []),
        ("mbtf-fit", ["--steps", "3", "--batch", "300", "--device", "cpu"]),
    ):
        words = [sys.executable, "-m", name.replace("-", "_")]
        (folder / name).write_text(f'#!/bin/sh\nexec {shlex.join(words)} "$@" {shlex.join(options)}\n')
        (folder / name).chmod(0o755)


def wait_for_jobs(seconds: float = 240.0) -> None:
    end = time.monotonic() + seconds
    while subprocess.run(["squeue", "-h"], capture_output=True, check=True).stdout.strip():
        assert time.monotonic() < end
        time.sleep(0.5)


def test_an_array_job_gives_the_data_of_one_process(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    write_maps(tmp_path)
    install_programs(tmp_path / "bin")
    script = tmp_path / "slurm_array.sh"
    # The node has two cores.
    script.write_text(
        (ROOT / "examples" / script.name).read_text().replace("cpus-per-task=8", "cpus-per-task=1")
    )
    script.chmod(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    monkeypatch.setenv("SLICES", "3")
    submit = ["./slurm_array.sh", "maps", "out", *OPTIONS.split()]
    with slurm_node(monkeypatch):
        subprocess.run(submit, check=True)
        wait_for_jobs()
        logs = {path.name: path.read_text() for path in tmp_path.glob("slurm-*.out")}
        assert (tmp_path / "out/material/material.json").is_file(), logs
        # One file is lost; the same command makes it again.
        lost = tmp_path / "out/shards/train-00001.npz"
        lost.with_suffix(".json").unlink()
        lost.unlink()
        subprocess.run(submit, check=True)
        wait_for_jobs()
    assert len(logs) == 4
    plain = ["mbtf-gen", "maps", "-o", "plain", *OPTIONS.split()]
    subprocess.run(plain, check=True, capture_output=True)
    assert len(list(tmp_path.glob("plain/train-*.npz"))) > 3
    assert contents(tmp_path / "out/shards") == contents(tmp_path / "plain")
