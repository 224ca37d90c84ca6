"""A program that imports drjit before mbtf_gen gets a working LLVM or one clear error, never an abort."""

from __future__ import annotations

from conftest import RunPython

PROGRAM = """
import drjit.llvm
from mbtf_gen.render.runtime import load_mitsuba
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
    result = run_python("-c", PROGRAM, DRJIT_LIBLLVM_PATH=None)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith(("refused: Dr.Jit was imported before mbtf_gen", "works: [0, 1, 2, 2]"))
