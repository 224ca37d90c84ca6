"""The LLVM library with which Dr.Jit compiles its CPU kernels.

The distribution ``karellen-llvm-core`` contains ``libLLVM.so.N.M``. Dr.Jit reads ``DRJIT_LIBLLVM_PATH`` once,
when it is first imported. Therefore :func:`~mbtf_gen.engine.runtime.load_mitsuba` calls
:func:`use_shipped_llvm` first; importing a package changes no environment variable. A path that the user set
has priority.
"""

from __future__ import annotations

import ctypes
import os
import re
from pathlib import Path

from mbtf_core.files.folders import cache_folder

VARIABLE = "DRJIT_LIBLLVM_PATH"
CACHE_VARIABLE = "DRJIT_CACHE_DIR"
# LLVM 14 is refused by Dr.Jit; 15 is accepted and then aborts the process at the first `minimum`.
OLDEST_LLVM = 16

_LIBRARY = re.compile(r"libLLVM\.(so\.[0-9.]+|dylib)")
# Dependencies of libLLVM, in a folder beside it. It loads them by links to these names.
_RUNTIME = ("libunwind.so.1.0", "libc++abi.so.1.0", "libc++.so.1.0")


def shipped_llvm() -> Path | None:
    """Path of the libLLVM of the installation; None where there is none.

    It is found through the list of files of the installed distribution, in virtual environments, user and
    prefix installations alike.
    """
    from importlib.metadata import PackageNotFoundError, files

    try:
        recorded = files("karellen-llvm-core") or []
    except PackageNotFoundError:
        return None
    libraries = (Path(os.path.abspath(f.locate())) for f in recorded if _LIBRARY.fullmatch(f.name))
    return next((path for path in libraries if path.is_file()), None)


def chosen_llvm() -> str | None:
    """Value of ``DRJIT_LIBLLVM_PATH``; None where it is unset or empty: Dr.Jit then searches the system."""
    return os.environ.get(VARIABLE) or None


def _load_runtime(library: Path) -> None:
    """Load the C++ runtime of the shipped library where the links to it do not exist.

    The first interpreter that may write beside the library creates the links. There is none if an
    administrator installs and another user runs.
    """
    for path in (p for name in _RUNTIME for p in library.parent.glob(f"*-linux-gnu/{name}")):
        if not path.with_suffix("").exists():
            ctypes.CDLL(str(path))


def use_shipped_llvm() -> None:
    """Make Dr.Jit use the shipped LLVM and a kernel cache of its own, unless the user chose others.

    Sets ``DRJIT_LIBLLVM_PATH`` and ``DRJIT_CACHE_DIR`` where they are unset. It must run before ``drjit`` is
    imported and has no effect afterwards.
    """
    library = chosen_llvm()
    shipped = shipped_llvm()
    if library is None:
        if shipped is None:
            return
        library = os.environ[VARIABLE] = str(shipped)
    if shipped is not None and library == str(shipped):
        _load_runtime(shipped)
    # Kernels compiled by different LLVMs must not share a cache.
    os.environ.setdefault(CACHE_VARIABLE, str(cache_folder() / f"kernels-{Path(library).resolve().name}"))


def has_version(library: str) -> bool:
    """Whether a library reports a version: LLVM 16 and newer do.

    It loads the library: call it in a child process.

    Raises
    ------
    OSError : the library cannot be loaded
    """
    return hasattr(ctypes.CDLL(library), "LLVMGetVersion")
