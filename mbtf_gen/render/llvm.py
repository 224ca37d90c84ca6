"""The LLVM library that Dr.Jit compiles its CPU kernels with: where it lies, which version it is.

The distribution ``karellen-llvm-core`` brings ``libLLVM.so.N.M``. Dr.Jit reads ``DRJIT_LIBLLVM_PATH`` once,
when it is first imported, so :func:`use_shipped_llvm` runs on import of :mod:`mbtf_gen`. A path that the user
set wins.
"""

from __future__ import annotations

import ctypes
import os
import re
import sys
from pathlib import Path

VARIABLE = "DRJIT_LIBLLVM_PATH"
CACHE_VARIABLE = "DRJIT_CACHE_DIR"
# LLVM 14 is refused by Dr.Jit; 15 is accepted and then aborts the process at the first `minimum`.
OLDEST_LLVM = 16

Version = tuple[int, int, int]

_DISTRIBUTION = re.compile(r"karellen_llvm_core-[^/]*\.dist-info")
_RECORDED = re.compile(r"^([^,\n]*libLLVM\.(?:so\.[0-9.]+|dylib)),", re.MULTILINE)
_NUMBERS = re.compile(r"libLLVM[-.](?:so\.)?(\d+)(?:\.(\d+))?(?:\.(\d+))?")
# libLLVM needs these. They lie in a folder beside it under these names; those it asks for are links to them.
_RUNTIME = ("libunwind.so.1.0", "libc++abi.so.1.0", "libc++.so.1.0")


def shipped_llvm() -> Path | None:
    """Path of the libLLVM that came with the installation; None where there is none.

    Found through the list of files of the installed distribution, so a virtual environment, a user or a
    prefix installation all work.
    """
    # importlib.metadata would say the same but takes ten times as long to import.
    for entry in sys.path:
        try:
            names = [name for name in os.listdir(entry or ".") if _DISTRIBUTION.fullmatch(name)]
        except OSError:
            continue
        for name in names:
            try:
                record = Path(entry, name, "RECORD").read_text(encoding="utf-8")
            except OSError:
                continue
            for recorded in _RECORDED.findall(record):
                library = Path(os.path.abspath(Path(entry, recorded)))
                if library.is_file():
                    return library
    return None


def chosen_llvm() -> str | None:
    """What ``DRJIT_LIBLLVM_PATH`` says; None where it is unset or empty and Dr.Jit searches the system."""
    return os.environ.get(VARIABLE) or None


def cache_folder() -> Path:
    """Folder for what can be computed again: ``$XDG_CACHE_HOME/mbtf``, by default ``~/.cache/mbtf``."""
    base = os.environ.get("XDG_CACHE_HOME")
    return Path(base) / "mbtf" if base else Path(os.path.expanduser("~"), ".cache", "mbtf")


def _load_runtime(library: Path) -> None:
    """Load the C++ runtime that the shipped library needs where its links were never made.

    The links appear at the first start of an interpreter that may write beside the library, which never comes
    when an administrator installs and another user runs.
    """
    for path in (p for name in _RUNTIME for p in library.parent.glob(f"*-linux-gnu/{name}")):
        if not path.with_suffix("").exists():
            ctypes.CDLL(str(path))


def use_shipped_llvm() -> None:
    """Point Dr.Jit to the shipped LLVM and to a kernel cache of its own, unless the user said otherwise.

    Must run before ``drjit`` is imported; has no effect on it afterwards. Costs about a millisecond.
    """
    library = chosen_llvm()
    shipped = shipped_llvm()
    if library is None:
        if shipped is None:
            return
        library = os.environ[VARIABLE] = str(shipped)
    if shipped is not None and library == str(shipped):
        _load_runtime(shipped)
    # Kernels compiled by one LLVM must not be taken for those of another.
    os.environ.setdefault(CACHE_VARIABLE, str(cache_folder() / f"kernels-{Path(library).resolve().name}"))


def version_in_name(library: str | Path) -> Version | None:
    """Version in a library's file name (``libLLVM.so.23.1``, ``libLLVM-15.so.1``); None where it has none."""
    match = _NUMBERS.match(Path(library).resolve().name)
    if match is None:
        return None
    major, minor, patch = (int(n or 0) for n in match.groups())
    return major, minor, patch


def version_of(library: str) -> Version | None:
    """Version that a library itself states; None where it does not (LLVM up to 15, or no LLVM).

    Loads the library: call it in a child process.

    Raises
    ------
    OSError : it cannot be loaded
    """
    loaded = ctypes.CDLL(library)
    if not hasattr(loaded, "LLVMGetVersion"):
        return None
    numbers = [ctypes.c_uint() for _ in range(3)]
    loaded.LLVMGetVersion(*(ctypes.byref(n) for n in numbers))
    return numbers[0].value, numbers[1].value, numbers[2].value
