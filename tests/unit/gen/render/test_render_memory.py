"""Kernels read whole packets of NumPy's memory: room behind it keeps them within the process's own."""

from __future__ import annotations

from conftest import RunPython

# Numbers at the end of readable memory.
CODE = """
import ctypes, mmap, sys
import numpy as np
from mbtf_gen.engine.types import padded
from mbtf_gen.engine.runtime import load_mitsuba
mi = load_mitsuba()
import drjit as dr
half, n = 1 << 19, 1601
memory = mmap.mmap(-1, 2 * half)
start = ctypes.addressof(ctypes.c_char.from_buffer(memory))
assert ctypes.CDLL(None).mprotect(ctypes.c_void_p(start + half), half, 0) == 0
numbers = np.frombuffer(memory, np.uint32, count=n, offset=half - 4 * n)
if sys.argv[1] == "padded":
    numbers = padded(numbers)
copied = mi.UInt32(numbers) + dr.opaque(mi.UInt32, 1)
dr.eval(copied)
assert (np.array(copied) == 1).all()
"""


def test_kernels_stay_within_the_memory_of_the_process(run_python: RunPython) -> None:
    assert run_python("-c", CODE, "padded").returncode == 0
    # Where this passes, Dr.Jit reads no further any more, and nothing needs to be padded.
    assert run_python("-c", CODE, "plain").returncode != 0
