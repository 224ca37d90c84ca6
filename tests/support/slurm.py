"""A SLURM of one node for tests that need root and Debian's packages slurm-wlm and munge."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from .paths import ROOT

SLURM = ROOT / "tests" / "system" / "slurm"


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
