"""The installation as a user meets it: the diagnosis of this machine, the console scripts."""

from __future__ import annotations

import json
from importlib.metadata import entry_points
from pathlib import Path

import pytest
from conftest import RunPython
from support.paths import ASSETS

from mbtf_gen import doctor


def test_a_healthy_installation_passes_its_checks(run_python: RunPython) -> None:
    done = run_python("-m", "mbtf_gen", "doctor", "--json")
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout)
    assert found["ok"]
    assert [c["name"] for c in found["checks"]] == [c.name for c in doctor.all_checks()]
    assert [c for c in found["checks"] if c["required"] and c["state"] != "ok"] == []


def test_the_physics_is_right_on_this_machine(run_python: RunPython) -> None:
    done = run_python("-m", "mbtf_gen", "selftest", "--time", "1s", "--json", "--quiet")
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout)
    assert found["ok"]
    assert {c["state"] for c in found["checks"]} <= {"ok", "absent"}
    assert all(c["worst"] is not None for c in found["checks"] if c["required"])


def test_the_three_programs_are_installed() -> None:
    scripts = {e.name: e.value for e in entry_points(group="console_scripts") if e.name.startswith("mbtf-")}
    assert scripts == {
        "mbtf-gen": "mbtf_gen.__main__:main",
        "mbtf-fit": "mbtf_fit.__main__:main",
        "mbtf-pipeline": "mbtf_pipeline.__main__:main",
    }


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
