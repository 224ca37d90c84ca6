"""The LLVM library with which Dr.Jit compiles its CPU kernels: its path and its version.

The distribution ``karellen-llvm-core`` contains ``libLLVM.so.N.M``. Dr.Jit reads ``DRJIT_LIBLLVM_PATH`` once,
when it is first imported. Therefore :func:`~mbtf_gen.render.runtime.load_mitsuba` calls
:func:`use_shipped_llvm` first; importing a package changes no environment variable. A path that the user set
has priority.
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
# Dependencies of libLLVM, in a folder beside it. It loads them by links to these names.
_RUNTIME = ("libunwind.so.1.0", "libc++abi.so.1.0", "libc++.so.1.0")


def shipped_llvm() -> Path | None:
    """Path of the libLLVM of the installation; None where there is none.

    It is found through the list of files of the installed distribution, in virtual environments, user and
    prefix installations alike.
    """
    # importlib.metadata would find the same but takes ten times as long to import.
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
    """Value of ``DRJIT_LIBLLVM_PATH``; None where it is unset or empty: Dr.Jit then searches the system."""
    return os.environ.get(VARIABLE) or None


def cache_folder() -> Path:
    """Cache folder: ``$XDG_CACHE_HOME/mbtf``, by default ``~/.cache/mbtf``."""
    base = os.environ.get("XDG_CACHE_HOME")
    return Path(base) / "mbtf" if base else Path(os.path.expanduser("~"), ".cache", "mbtf")


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
    imported and has no effect afterwards. It takes about a millisecond.
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


def version_in_name(library: str | Path) -> Version | None:
    """Version in a library's file name (``libLLVM.so.23.1``, ``libLLVM-15.so.1``); None where it has none."""
    match = _NUMBERS.match(Path(library).resolve().name)
    if match is None:
        return None
    major, minor, patch = (int(n or 0) for n in match.groups())
    return major, minor, patch


def version_of(library: str) -> Version | None:
    """Version that a library reports; None where it reports none (LLVM up to 15, or another library).

    It loads the library: call it in a child process.

    Raises
    ------
    OSError : the library cannot be loaded
    """
    loaded = ctypes.CDLL(library)
    if not hasattr(loaded, "LLVMGetVersion"):
        return None
    numbers = [ctypes.c_uint() for _ in range(3)]
    loaded.LLVMGetVersion(*(ctypes.byref(n) for n in numbers))
    return numbers[0].value, numbers[1].value, numbers[2].value
