"""The installation as a user meets it: the diagnosis of this machine, the console scripts."""

from __future__ import annotations

import json
from importlib.metadata import entry_points, version

from conftest import RunPython

from mbtf_gen import doctor


def test_a_healthy_installation_passes_its_diagnosis() -> None:
    checks = doctor.diagnose()
    assert [c.name for c in checks] == [
        "Python",
        "LLVM",
        "Mitsuba",
        "Threads",
        "CUDA",
        "PyTorch",
        "OpenEXR",
        "Drawing",
        "Kernel cache",
    ]
    assert [c for c in checks if c.required and c.state != "ok"] == []
    assert doctor.exit_code(checks) == 0
    data = json.loads(json.dumps(doctor.as_json(checks)))
    assert data["healthy"] is True
    assert [c["name"] for c in data["checks"]] == [c.name for c in checks]
    assert set(data["checks"][0]) == {"name", "state", "required", "found", "cure"}


def test_the_three_programs_are_installed() -> None:
    scripts = {e.name: e.value for e in entry_points(group="console_scripts") if e.name.startswith("mbtf-")}
    assert scripts == {
        "mbtf-gen": "mbtf_gen.__main__:main",
        "mbtf-fit": "mbtf_fit.__main__:main",
        "mbtf-pipeline": "mbtf_pipeline.__main__:main",
    }


def test_pinned_versions_are_installed(run_python: RunPython) -> None:
    assert version("mitsuba") == "3.9.1"
    assert version("torch").split("+")[0] == "2.13.0"
