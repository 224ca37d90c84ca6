"""``--help`` answers at once: it loads none of the libraries that take seconds."""

from __future__ import annotations

import pytest
from conftest import RunPython

PROGRAMS = {"mbtf-gen": "mbtf_gen", "mbtf-fit": "mbtf_fit", "mbtf-pipeline": "mbtf_pipeline"}
HEAVY = {"torch", "mitsuba", "drjit", "matplotlib", "scipy", "trimesh", "OpenEXR", "pyarrow"}
HEAVY |= {"h5py", "dask", "distributed"}
CODE = """
import sys
sys.argv = [{program!r}, "--help"]
from {package}.__main__ import main
assert main() == 0
from {package}.cli.app import app
from mbtf_core.app.console import run
for name in app:
    if not name.startswith("-"):
        print("command:", name)
        assert run(app, [name, "--help"]) == 0
print("loaded:", *({heavy!r} & set(sys.modules)))
"""


@pytest.mark.parametrize("program", PROGRAMS)
def test_help_answers_without_heavy_modules(program: str, run_python: RunPython) -> None:
    """Of the program and of each of its commands."""
    code = CODE.format(program=program, package=PROGRAMS[program], heavy=HEAVY)
    done = run_python("-c", code, COLUMNS="80")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    shown, _, loaded = done.stdout.rpartition("loaded:")
    assert loaded.split() == []
    assert shown.count(f"Usage: {program}") == 1 + shown.count("command: ") > 4
