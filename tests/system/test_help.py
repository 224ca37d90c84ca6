"""``--help`` answers at once: it loads none of the libraries that take seconds."""

from __future__ import annotations

import sys

import pytest
from conftest import RunPython

PROGRAMS = {"mbtf-gen": "mbtf_gen", "mbtf-fit": "mbtf_fit", "mbtf-pipeline": "mbtf_pipeline"}
HEAVY = {"torch", "mitsuba", "drjit", "matplotlib", "scipy", "trimesh", "pyvista", "OpenEXR", "pyarrow"}


def answer(program: str, arguments: list[str], run_python: RunPython) -> tuple[str, set[str]]:
    """What a program prints and the heavy modules that it loaded; it must exit with 0."""
    code = (
        f"import sys; sys.argv = [{program!r}, *{arguments!r}]\n"
        f"from {PROGRAMS[program]}.__main__ import main\n"
        "code = main()\n"
        f"print('loaded:', *({HEAVY!r} & set(sys.modules)))\n"
        "sys.exit(code)\n"
    )
    done = run_python("-c", code, COLUMNS="100")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    text, _, loaded = done.stdout.rpartition("loaded:")
    return text, set(loaded.split())


@pytest.mark.parametrize("program", PROGRAMS)
def test_help_answers_without_heavy_modules(program: str, run_python: RunPython) -> None:
    text, loaded = answer(program, ["--help"], run_python)
    assert loaded == set()
    assert f"Usage: {program}" in text
    assert "--version" in text


@pytest.mark.parametrize(
    ("program", "command"),
    [
        *(("mbtf-gen", c) for c in ("plan", "inspect", "verify", "repair", "merge", "preview", "reference")),
        *(("mbtf-gen", c) for c in ("selftest", "doctor", "import", "export", "publish")),
        *(("mbtf-fit", c) for c in ("evaluate", "export", "info", "preview")),
        *(("mbtf-pipeline", c) for c in ("run", "list", "report", "cost")),
    ],
)
def test_every_command_has_help(program: str, command: str, run_python: RunPython) -> None:
    text, loaded = answer(program, [command, "--help"], run_python)
    assert loaded == set()
    assert f"Usage: {program} {command}" in text


@pytest.mark.parametrize("program", PROGRAMS)
def test_version_answers_without_heavy_modules(program: str, run_python: RunPython) -> None:
    text, loaded = answer(program, ["--version"], run_python)
    assert loaded == set()
    assert text.startswith(f"{program} ")


@pytest.mark.parametrize("package", PROGRAMS.values())
def test_programs_run_as_modules(package: str, run_python: RunPython) -> None:
    done = run_python("-m", package, "--version")
    assert (done.returncode, done.stderr) == (0, "")


def test_the_list_of_heavy_modules_can_catch_something(run_python: RunPython) -> None:
    done = run_python("-c", f"import sys, trimesh; print(*({HEAVY!r} & set(sys.modules)))")
    assert "trimesh" in done.stdout.split(), sys.version
