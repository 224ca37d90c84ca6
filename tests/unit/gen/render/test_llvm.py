"""The LLVM library: found without the user, never the cause of an abort; its threads and memory."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from conftest import RunPython

from mbtf_core.errors import EngineError
from mbtf_core.run.task import THREADS_VARIABLE
from mbtf_gen.engine import runtime as engine

LOAD = """
from mbtf_gen.engine.runtime import load_mitsuba
from mbtf_core.errors import MbtfError
try:
    print(load_mitsuba().variant())
except MbtfError as error:
    print(type(error).__name__ + "|" + error.message.replace(chr(10), "|"))
"""


OLD = sorted(Path("/usr/lib").glob("*/libLLVM-1[0-5].so.1"))


def test_it_is_found_and_works_with_nothing_set(run_python: RunPython, tmp_path: Path) -> None:
    done = run_python(
        "-c",
        LOAD + "import os; print(os.environ['DRJIT_LIBLLVM_PATH'])",
        DRJIT_LIBLLVM_PATH=None,
        DRJIT_CACHE_DIR=None,
        XDG_CACHE_HOME=str(tmp_path),
    )
    assert done.stdout.splitlines() == ["llvm_ad_rgb", str(engine.shipped_llvm())]
    assert done.stderr == ""
    assert any(p.name.startswith("llvm-proof-") for p in (tmp_path / "mbtf").iterdir())


@pytest.mark.skipif(not OLD, reason="no LLVM older than 16 on this machine")
def test_an_old_llvm_is_refused(run_python: RunPython) -> None:
    done = run_python("-c", LOAD, DRJIT_LIBLLVM_PATH=str(OLD[-1]))
    assert done.returncode == 0
    assert "is older than LLVM 16" in done.stdout
    assert done.stderr == ""


def test_an_installation_never_started_by_its_owner_works(run_python: RunPython, tmp_path: Path) -> None:
    # Links of the C++ runtime appear at the first start that may write; here they never did.
    shipped = engine.shipped_llvm()
    runtime = sorted({p.resolve() for p in shipped.parent.glob("*-linux-gnu/lib*.so.*")})
    if not runtime:
        pytest.skip("the library brings no C++ runtime on this platform")
    folder = tmp_path / "lib"
    (folder / runtime[0].parent.name).mkdir(parents=True)
    shutil.copy(shipped, folder)
    for library in runtime:
        shutil.copy(library, folder / library.parent.name)
    record = tmp_path / "site" / "karellen_llvm_core-99.dist-info"
    record.mkdir(parents=True)
    (record / "RECORD").write_text(f"../lib/{shipped.name},sha256=x,1\n")
    code = f"import sys; sys.path.insert(0, {str(record.parent)!r})\n{LOAD}"
    done = run_python(
        "-c", code, DRJIT_LIBLLVM_PATH=None, DRJIT_CACHE_DIR=None, XDG_CACHE_HOME=str(tmp_path / "cache")
    )
    assert done.stdout == "llvm_ad_rgb\n"


def test_a_proof_is_cached_per_library_unless_it_fails(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Of a library that the user chose, with an empty cache."""
    library = tmp_path / "libLLVM.so.20.1"
    library.write_bytes(b"x")
    monkeypatch.setenv(engine.VARIABLE, str(library))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    proofs, fault = [], "the process was ended by SIGABRT (LLVM ERROR: Cannot select)"

    def prove(variant: str) -> object:
        proofs.append(variant)
        return engine.ChildResult({"llvm": [20, 1, 2]}, fault, 0.0)

    monkeypatch.setattr(engine, "prove", prove)
    for _ in range(2):
        with pytest.raises(EngineError, match="ended by SIGABRT"):
            engine.check_llvm()
    assert len(proofs) == 2
    fault = ""
    for content in (b"x", b"changed"):
        library.write_bytes(content)
        engine.check_llvm()
        engine.check_llvm()
    assert len(proofs) == 4


SHOWN = """
from mbtf_gen.engine.runtime import load_mitsuba
load_mitsuba()
import drjit
print(drjit.thread_count())
"""


def test_a_worker_renders_with_its_threads(run_python: RunPython) -> None:
    shown = run_python("-c", SHOWN, **{THREADS_VARIABLE: "3"})
    assert shown.stdout.split() == ["3"], shown.stderr


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
