"""The diagnosis: uses each part, and gives a hint for each failure."""

from __future__ import annotations

from pathlib import Path

import pytest

from mbtf_core.run.processes import ChildResult
from mbtf_gen.diagnostics import doctor
from mbtf_gen.diagnostics.doctor import Part
from mbtf_gen.engine import llvm


@pytest.mark.parametrize("required", [True, False])
def test_only_required_parts_fail_the_diagnosis(required: bool) -> None:
    checks = [Part("Python", "ok", True, "3.11"), Part("LLVM", "failed", required, "is LLVM 15", "unset it")]
    assert doctor.exit_code(checks) == (3 if required else 0)
    assert doctor.as_json(checks)["healthy"] is not required
    assert "                → unset it" in doctor.as_text(checks).splitlines()


def test_a_broken_llvm_is_a_finding_not_a_crash(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    fake = tmp_path / "libLLVM.so"
    fake.write_text("no library\n")
    monkeypatch.setenv(llvm.VARIABLE, str(fake))
    found = {c.name: c for c in (doctor._llvm(), doctor.probe("Mitsuba"))}
    assert {c.state for c in found.values()} == {"failed"}
    assert str(fake) in found["LLVM"].found
    assert "unset" in found["LLVM"].hint
    assert doctor.exit_code(list(found.values())) == 3


def test_an_abort_of_the_drawing_library_is_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    fault = "the process was ended by SIGSEGV"
    monkeypatch.setattr(doctor, "run_child", lambda *a, **k: ChildResult({}, fault, 0.1))
    check = doctor.probe("Drawing")
    assert (check.state, check.required, check.found) == ("failed", False, fault)
    assert "OpenGL" in check.hint


def test_an_unwritable_kernel_cache_is_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv(llvm.CACHE_VARIABLE, str(tmp_path / "file"))
    check = doctor.probe("Kernel cache")
    assert check.state == "failed"
    assert not check.required
    assert llvm.CACHE_VARIABLE in check.hint
