"""The installation as a user meets it: the diagnosis of this machine, the console scripts."""

from __future__ import annotations

import json
from importlib.metadata import entry_points
from pathlib import Path

import pytest
from conftest import RunPython
from support.paths import ROOT

from mbtf_gen.diagnostics import doctor


def test_a_healthy_installation_passes_its_diagnosis() -> None:
    checks = doctor.diagnose()
    assert [c.name for c in checks] == ["Python", "LLVM", "CUDA", *doctor.PROBES]
    assert [c for c in checks if c.required and c.state != "ok"] == []
    assert doctor.exit_code(checks) == 0
    data = json.loads(json.dumps(doctor.as_json(checks)))
    assert data["healthy"] is True
    assert [c["name"] for c in data["checks"]] == [c.name for c in checks]
    assert set(data["checks"][0]) == {"name", "state", "required", "found", "hint"}


def test_the_three_programs_are_installed() -> None:
    scripts = {e.name: e.value for e in entry_points(group="console_scripts") if e.name.startswith("mbtf-")}
    assert scripts == {
        "mbtf-gen": "mbtf_gen.__main__:main",
        "mbtf-fit": "mbtf_fit.__main__:main",
        "mbtf-pipeline": "mbtf_pipeline.__main__:main",
    }


@pytest.mark.parametrize("content", [b"no library\n", b"\x7fELF" + bytes(4096), None])
@pytest.mark.parametrize(
    "arguments",
    [
        ["mbtf_gen", "{asset}", "--queries", "10", "--test-queries", "10", "-o", "{out}"],
        ["mbtf_gen", "reference", "{asset}", "--size", "8", "-o", "{out}"],
    ],
    ids=["generate", "reference"],
)
def test_a_broken_llvm_ends_every_rendering_command_in_one_clear_error(
    arguments: list[str], content: bytes | None, tmp_path: Path, run_python: RunPython
) -> None:
    library = tmp_path / "libLLVM.so"
    if content is not None:
        library.write_bytes(content)
    asset = ROOT / "assets" / "turtle_shell"
    filled = [a.format(asset=asset, out=tmp_path / "out") for a in arguments]
    done = run_python("-m", *filled, "--quiet", DRJIT_LIBLLVM_PATH=str(library))
    assert done.returncode == 3
    lines = done.stderr.splitlines()
    assert len(lines) == 2
    assert lines[0].startswith(f"error: DRJIT_LIBLLVM_PATH={library}: ")
    assert "unset it" in lines[1]
    assert done.stdout == ""
