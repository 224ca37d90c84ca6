"""The kernel is compiled when the package is installed, and its absence breaks nothing."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest
from support.paths import ROOT

from mbtf_fit.native import library

try:
    # Not imported: it would replace the standard library's distutils for the tests that follow.
    SETUPTOOLS = int(version("setuptools").split(".")[0])
except PackageNotFoundError:
    SETUPTOOLS = 0
pytestmark = pytest.mark.skipif(SETUPTOOLS < 77, reason="pip install 'setuptools>=77' to build the kernel")


def build(out: Path, **variables: str) -> tuple[list[Path], str]:
    """Run the build step of an installation; returns the libraries that it made, and its output."""
    command = ["setup.py", "build_ext", "--build-lib", str(out), "--build-temp", str(out / "temp")]
    options = {"capture_output": True, "text": True, "timeout": 300, "check": False}
    done = subprocess.run([sys.executable, *command], cwd=ROOT, env={**os.environ, **variables}, **options)
    assert done.returncode == 0, done.stderr
    return sorted((out / "mbtf_fit").rglob(f"{library.LIBRARY}*")), done.stdout + done.stderr


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler is installed here")
def test_it_is_built_where_there_is_a_compiler(tmp_path: Path) -> None:
    # Without optimization, which takes most of the time.
    compiler = tmp_path / "cc"
    compiler.write_text('#!/bin/sh\nexec cc "$@" -O0\n')
    compiler.chmod(0o755)
    (path,), _ = build(tmp_path / "out", CC=str(compiler))
    assert path.name.removeprefix(library.LIBRARY) in EXTENSION_SUFFIXES
    assert ".cpython-" not in path.name  # of all versions of Python
    loaded = library.open_library(path)
    assert "portable" in library.variants(loaded)


def test_an_installation_without_a_compiler_succeeds(tmp_path: Path) -> None:
    made, output = build(tmp_path, CC="/no/such/compiler")
    assert made == []
    assert sum("fits will run in PyTorch" in line for line in output.splitlines()) == 1


def test_a_wheel_for_any_machine_has_no_kernel(tmp_path: Path) -> None:
    assert build(tmp_path, MBTF_KERNEL="off")[0] == []
