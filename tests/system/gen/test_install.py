"""The installation as a user meets it: diagnosis of this machine, environment and order of imports."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from conftest import RunPython
from support.paths import ASSETS

from mbtf_gen.diagnostics import doctor


def test_a_healthy_installation_passes_its_checks(run_python: RunPython) -> None:
    done = run_python("-m", "mbtf_gen", "doctor", "--json")
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout)
    assert found["ok"]
    assert [c["name"] for c in found["checks"]] == [c.name for c in doctor.all_checks()]
    assert [c for c in found["checks"] if c["required"] and c["state"] != "ok"] == []


def test_the_physics_is_right_on_this_machine(run_python: RunPython) -> None:
    done = run_python("-m", "mbtf_gen", "selftest", "--json", "--quiet")
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout)
    assert found["ok"]
    assert {c["state"] for c in found["checks"]} <= {"ok", "absent"}


@pytest.mark.parametrize("command", [[], ["reference"]], ids=["generate", "reference"])
def test_a_broken_llvm_ends_every_rendering_command_in_one_clear_error(
    command: list[str], tmp_path: Path, run_python: RunPython
) -> None:
    library = tmp_path / "libLLVM.so"
    library.write_bytes(b"\x7fELF" + bytes(4096))
    line = [*command, str(ASSETS / "turtle_shell"), "-o", str(tmp_path / "out"), "--quiet"]
    done = run_python("-m", "mbtf_gen", *line, DRJIT_LIBLLVM_PATH=str(library))
    assert done.returncode == 3
    lines = done.stderr.splitlines()
    assert len(lines) == 2
    assert lines[0].startswith(f"error: DRJIT_LIBLLVM_PATH={library}: ")
    assert "unset it" in lines[1]
    assert done.stdout == ""


EARLY = """
import drjit.llvm
from mbtf_gen.engine.runtime import load_mitsuba
from mbtf_core.errors import EngineError
try:
    mi = load_mitsuba()
except EngineError as error:
    print("refused:", error.what)
else:
    import drjit as dr
    print("works:", dr.minimum(dr.arange(mi.Float, 4), 2))
"""


def test_import_order(run_python: RunPython) -> None:
    """A program that imports drjit first gets a working LLVM or one clear error, never an abort."""
    result = run_python("-c", EARLY, DRJIT_LIBLLVM_PATH=None)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith(("refused: Dr.Jit was imported first", "works: [0, 1, 2, 2]"))


def test_importing_the_packages_changes_no_variable(run_python: RunPython) -> None:
    packages = "mbtf_core, mbtf_gen, mbtf_fit, mbtf_fit.backends.mitsuba, mbtf_pipeline"
    code = f"import os; before = dict(os.environ); import {packages}; print(os.environ == before)"
    done = run_python("-c", code, DRJIT_LIBLLVM_PATH=None, DRJIT_CACHE_DIR=None)
    assert (done.stdout, done.stderr) == ("True\n", "")
