"""Diagnosis of the machine: each part is used, and each failure comes with a hint.

A part fails by aborting or hanging as often as by an exception, therefore in a child process
(:mod:`mbtf_core.run.processes`).
"""

from __future__ import annotations

import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

from mbtf_core.errors import EngineError
from mbtf_core.run.processes import run_child
from mbtf_gen.diagnostics.checks import Absent, Check
from mbtf_gen.engine.runtime import (
    CACHE_VARIABLE,
    CPU_VARIANT,
    CUDA_VARIANT,
    check_llvm,
    chosen_llvm,
    prove,
    shipped_llvm,
)

# Seconds; first starts from a slow network disk take tens of them.
_TIMEOUT = 180.0
_REINSTALL = "install again: pip install --force-reinstall"
_CACHE = f"without it every run compiles its kernels again; make its folder writable or set {CACHE_VARIABLE}"


def all_checks() -> list[Check]:
    """Every part of the machine, in the order in which they are reported."""
    return [
        Check("Python", _python),
        Check("Mitsuba", _mitsuba, hint=f"{_REINSTALL} mitsuba==3.9.1 karellen-llvm-core"),
        Check("CUDA", _cuda, required=False),
        Check("PyTorch", partial(_in_child, use_torch), hint=f"{_REINSTALL} 'torch>=2.13,<2.15'"),
        Check("Kernel cache", partial(_in_child, use_kernel_cache), required=False, hint=_CACHE),
    ]


def _in_child(use: Callable[[], Iterator[dict[str, str]]]) -> str:
    """Call a function of this module in a child process; it yields ``found``, in words."""
    outcome = run_child(__name__, use.__name__, timeout=_TIMEOUT)
    if outcome.fault:
        raise EngineError(outcome.fault)
    return str(outcome.answers["found"])


def _python() -> str:
    free = shutil.disk_usage(Path.cwd()).free
    found = f"{platform.python_version()} on {platform.platform(terse=True)}, {sys.executable}; "
    return f"{found}{free / 1e9:.1f} GB free in {Path.cwd()}"


def _mitsuba() -> str:
    library = chosen_llvm()
    # Tested again: a cached result does not show the state of today.
    outcome = prove(CPU_VARIANT)
    if outcome.fault:
        check_llvm()
        raise EngineError(outcome.fault)
    numbers = ".".join(str(n) for n in outcome.answers["llvm"])
    origin = "set by the user"
    if library is None or library == str(shipped_llvm()):
        origin = "of the system" if library is None else "of the installation"
    programs = f"{version('mitsuba')} with Dr.Jit {version('drjit')} and LLVM {numbers} {origin}"
    return f"{programs} ({library or 'found by Dr.Jit'}) ran test kernels"


def _cuda() -> str:
    outcome = prove(CUDA_VARIANT)
    if outcome.fault:
        raise Absent(f"{outcome.fault}; the CPU is used")
    return "ran test kernels"


# The functions below run in child processes.


def use_torch() -> Iterator[dict[str, str]]:
    """PyTorch takes a derivative; is the compiled kernel there?"""
    # By name: this package does not depend on PyTorch, but the fitter in the same installation does.
    torch: Any = import_module("torch")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    weight = torch.zeros(1, device=device, requires_grad=True)
    (weight - 1).square().sum().backward()
    if weight.grad.item() != -2.0:
        raise EngineError(f"a derivative is {weight.grad.item()} instead of -2")
    compiled = import_module("mbtf_fit.native.library").kernel() is not None
    speed = "" if compiled or device == "cuda" else "; without the compiled kernel, fits take longer"
    yield {"found": f"{torch.__version__} on {device}, took a derivative{speed}"}


def use_kernel_cache() -> Iterator[dict[str, str]]:
    """The folder of compiled kernels is writable."""
    folder = Path(os.environ.get(CACHE_VARIABLE) or "~/.drjit").expanduser()
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=folder, prefix=".doctor-"):
        sizes = [entry.stat().st_size for entry in os.scandir(folder)]
    yield {"found": f"{folder}, {len(sizes)} files, {sum(sizes) / 2**10:.0f} KiB"}
