"""Loading of Mitsuba: chooses the LLVM of Dr.Jit's CPU kernels, checks that it works, sets the variant.

The distribution ``karellen-llvm-core`` contains ``libLLVM.so.N.M``. Dr.Jit reads ``DRJIT_LIBLLVM_PATH`` once,
when it is first imported, so :func:`load_mitsuba` sets it before, unless the user did. A broken or old LLVM
aborts the process at some kernel. Therefore test kernels run in a child process first, once per library, and
the result is cached. Modules that import ``drjit`` or ``mitsuba`` at the top must be imported after
:func:`load_mitsuba`.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import re
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from mbtf_core.errors import EngineError, UsageError
from mbtf_core.files.folders import cache_folder
from mbtf_core.run.processes import ChildResult, run_child
from mbtf_core.run.task import worker_threads

CPU_VARIANT = "llvm_ad_rgb"
CUDA_VARIANT = "cuda_ad_rgb"
VARIABLE = "DRJIT_LIBLLVM_PATH"
CACHE_VARIABLE = "DRJIT_CACHE_DIR"
# LLVM 14 is refused by Dr.Jit; 15 is accepted and then aborts the process at the first `minimum`.
OLDEST_LLVM = 16

_LIBRARY = re.compile(r"libLLVM\.(so\.[0-9.]+|dylib)")
# Dependencies of libLLVM, in a folder beside it. It loads them by links to these names.
_RUNTIME = ("libunwind.so.1.0", "libc++abi.so.1.0", "libc++.so.1.0")
# Seconds; a first start from a slow network disk takes tens of them.
_PROOF_TIMEOUT = 180.0

_working: set[str] = set()


def load_mitsuba(variant: str = CPU_VARIANT) -> Any:
    """Import Mitsuba and set a variant, ``llvm_ad_rgb`` or ``cuda_ad_rgb``; returns the module ``mitsuba``.

    Sets ``DRJIT_LIBLLVM_PATH`` and ``DRJIT_CACHE_DIR`` where they are unset.

    Raises
    ------
    UsageError : the variant does not exist
    EngineError : Mitsuba, its LLVM or the CUDA device cannot be used here; says why and what to do
    """
    if variant not in (CPU_VARIANT, CUDA_VARIANT):
        raise UsageError(f"no variant '{variant}'", hint=f"choose {CPU_VARIANT} or {CUDA_VARIANT}")
    if variant not in _working:
        if variant == CPU_VARIANT:
            check_llvm()
        elif fault := prove(variant).fault:
            raise EngineError(f"no usable CUDA device ({fault})", hint=f"use the CPU: variant {CPU_VARIANT}")
    try:
        import mitsuba

        if mitsuba.variant() != variant:
            mitsuba.set_variant(variant)
    except ImportError as error:
        raise _mitsuba_error(" ".join(str(error).split())) from None
    if variant == CPU_VARIANT:
        refuse_old_llvm()
        # Workers share the processors of their machine.
        if variant not in _working and (threads := worker_threads()) is not None:
            import drjit

            drjit.set_thread_count(threads)
    _working.add(variant)
    return mitsuba


def shipped_llvm() -> Path | None:
    """Path of the libLLVM of the installation, by the list of its files; None where there is none."""
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
    """Load the C++ runtime of the shipped library where the links to it do not exist: the first interpreter
    that may write beside the library creates them, and there may be none."""
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
    """Whether a library reports a version, as LLVM 16 and newer do. It is loaded: use a child process."""
    return hasattr(ctypes.CDLL(library), "LLVMGetVersion")


def refuse_old_llvm() -> None:
    """Raise an EngineError if Dr.Jit uses an LLVM with which some kernel would abort the process: that of the
    system, where a program imports ``mitsuba`` or ``drjit`` first."""
    import drjit

    major = int(drjit.detail.llvm_version()[0])
    if major < OLDEST_LLVM:
        raise EngineError(
            f"Dr.Jit was imported first and uses LLVM {major}, which is too old",
            hint='call mbtf_fit.backends.mitsuba.register("llvm_ad_rgb") before importing mitsuba or drjit',
        )


def prove(variant: str) -> ChildResult:
    """Compile and run test kernels of `variant` in a child process, without the disk cache.

    The answers contain ``llvm`` (version) for the CPU variant.
    """
    use_shipped_llvm()
    with tempfile.TemporaryDirectory(prefix="mbtf-proof-") as folder:
        return run_child(
            __name__, "_proof", variant, timeout=_PROOF_TIMEOUT, environment={CACHE_VARIABLE: folder}
        )


def check_llvm() -> None:
    """Test the LLVM that Dr.Jit will use, unless an earlier run on this machine did; an EngineError if it is
    missing, broken or too old."""
    use_shipped_llvm()
    library = chosen_llvm()
    passed = _proof_file(library)
    if passed is not None and passed.exists():
        return
    fault = prove(CPU_VARIANT).fault
    if "No module named" in fault:
        raise _mitsuba_error(fault)
    if fault:
        raise _llvm_error(library, fault)
    if passed is not None:
        with suppress(OSError):  # without a writable cache the next process tests it again
            passed.parent.mkdir(parents=True, exist_ok=True)
            passed.touch()


def _proof_file(library: str | None) -> Path | None:
    """File that exists once the test passed: of this library file, this Dr.Jit, this machine's name."""
    from importlib.metadata import PackageNotFoundError, version

    if library is None or not Path(library).is_file():
        return None
    try:
        drjit = version("drjit")
    except PackageNotFoundError:
        return None
    real = Path(library).resolve()
    state = real.stat()
    key = f"{real}|{state.st_size}|{state.st_mtime_ns}|{drjit}|{platform.node()}"
    return cache_folder() / f"llvm-proof-{hashlib.sha256(key.encode()).hexdigest()[:16]}"


def _llvm_error(library: str | None, fault: str) -> EngineError:
    again = "pip install --force-reinstall karellen-llvm-core"
    if library is None:
        what, hint = f"no usable LLVM library was found ({fault})", f"{again}, into a virtual environment"
        return EngineError(
            what, hint=f"{hint}, or set {VARIABLE} to a libLLVM of version {OLDEST_LLVM} or newer"
        )
    shipped = shipped_llvm()
    if shipped is not None and library == str(shipped):
        what = f"the LLVM that came with the installation cannot be used: {fault}"
        return EngineError(what, where=library, hint=f"install it again: {again}")
    return EngineError(
        fault, where=f"{VARIABLE}={library}", hint=f"unset it ({again}), or name a newer libLLVM"
    )


def _mitsuba_error(fault: str) -> EngineError:
    return EngineError(
        f"Mitsuba cannot be loaded ({fault})",
        hint="install it again: pip install --force-reinstall mitsuba==3.9.1",
    )


def _proof(variant: str) -> Iterator[dict[str, Any]]:
    """Child process of :func:`prove`."""
    use_shipped_llvm()
    library = chosen_llvm()
    needed = f"LLVM {OLDEST_LLVM} or newer is needed"
    if variant == CPU_VARIANT and library is not None:
        try:
            new = has_version(library)
        except OSError as error:
            raise EngineError(f"cannot be loaded ({str(error).removeprefix(f'{library}: ')})") from None
        if not new:
            raise EngineError(f"is older than LLVM {OLDEST_LLVM}, or not LLVM at all; {needed}")
    import drjit as dr
    import mitsuba as mi

    try:
        mi.set_variant(variant)
    except ImportError:
        if variant == CUDA_VARIANT:
            raise EngineError("no driver or no device was found") from None
        raise
    if variant == CPU_VARIANT:
        found = dr.detail.llvm_version()
        yield {"llvm": found}
        if found[0] < OLDEST_LLVM:
            raise EngineError(f"is LLVM {found[0]}; {needed}")
    _exercise(mi, dr)


def _exercise(mi: Any, dr: Any) -> None:
    """Run kernels of the kinds that rendering uses: arithmetic, a symbolic loop, random numbers, a ray."""
    n = 4096
    index = dr.arange(mi.UInt32, n)
    x = mi.Float(index) / n
    if dr.sum(dr.minimum(mi.Float(index), 3) + dr.maximum(-x, 0))[0] != 3 * n - 6:
        raise EngineError("a test kernel computed a wrong minimum")
    generator = mi.PCG32(initstate=1, initseq=index)

    def add(i: Any, total: Any, state: Any) -> Any:
        return i + 1, total + state.next_float32(), state

    _, total, _ = dr.while_loop(
        (mi.UInt32(0), mi.Float(0), generator), lambda i, total, state: i < 8 + index % 8, add
    )
    mean = dr.sum(total)[0] / dr.sum(mi.Float(8 + index % 8))[0]
    # 47104 uniform numbers: six standard deviations of their mean are 0.008.
    if not abs(mean - 0.5) < 0.008:
        raise EngineError("a test kernel drew wrong random numbers")
    scene = mi.load_dict({"type": "scene", "shape": {"type": "rectangle"}})
    hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, 0.25, 1 + x), mi.Vector3f(0, 0, -1)))
    if not dr.all(dr.abs(hit.t - (1 + x)) < 1e-5)[0]:
        raise EngineError("a test ray missed its target")
