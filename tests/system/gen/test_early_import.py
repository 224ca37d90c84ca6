"""Environment and order of imports: packages change no variable; an early drjit is used or refused."""

from __future__ import annotations

from conftest import RunPython

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
