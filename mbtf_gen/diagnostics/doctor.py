"""Diagnosis of the machine: each part is used in a child process, and each failure comes with a hint.

A part fails by aborting or hanging as often as by an exception, therefore in a child process
(:mod:`mbtf_core.run.processes`).
"""

from __future__ import annotations

import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, NamedTuple

from mbtf_core.errors import EXIT_BAD_INPUT, EXIT_OK, EngineError
from mbtf_core.run.processes import run_child
from mbtf_gen.engine.llvm import CACHE_VARIABLE, chosen_llvm, shipped_llvm, use_shipped_llvm
from mbtf_gen.engine.runtime import CPU_VARIANT, CUDA_VARIANT, check_llvm, load_mitsuba, prove

Found = dict[Literal["found"], str]

# Seconds; first starts from a slow network disk take tens of them.
_TIMEOUT = 180.0
_REINSTALL = "install again: pip install --force-reinstall"


@dataclass(frozen=True)
class Part:
    """The state of one part of the machine.

    Attributes
    ----------
    state : ``absent`` parts are not there and not needed
    required : whether the programs need it
    found : what was found, or what went wrong
    hint : what to do about it; empty where nothing is to be done
    """

    name: str
    state: Literal["ok", "failed", "absent"]
    required: bool
    found: str
    hint: str = ""


class Probe(NamedTuple):
    """How a part is tested: `use` runs in a child process and yields ``found``, what it found in words."""

    use: Callable[[], Iterator[Found]]
    hint: str
    required: bool = True


def diagnose() -> list[Part]:
    """Test every part, several at a time. It takes seconds and never raises."""
    use_shipped_llvm()
    tests = [_python, _llvm, _cuda, *(partial(probe, name) for name in PROBES)]
    with ThreadPoolExecutor(max_workers=min(4, os.cpu_count() or 1)) as pool:
        return list(pool.map(lambda test: test(), tests))


def exit_code(parts: Sequence[Part]) -> int:
    """0, or 3 when something required failed."""
    return EXIT_BAD_INPUT if any(p.required and p.state != "ok" for p in parts) else EXIT_OK


def as_json(parts: Sequence[Part]) -> dict[str, Any]:
    """Plain data of the diagnosis: ``healthy`` and the list ``checks``."""
    return {"healthy": exit_code(parts) == EXIT_OK, "checks": [asdict(p) for p in parts]}


def as_text(parts: Sequence[Part]) -> str:
    """The diagnosis as a table with hints, and a closing line."""
    width = max(len(p.name) for p in parts)
    lines = []
    for part in parts:
        lines.append(f"{part.state:<7} {part.name:<{width}}  {part.found}")
        if part.hint:
            lines.append(f"{'':<7} {'':<{width}}  → {part.hint}")
    works = exit_code(parts) == EXIT_OK
    closing = (
        "every required part works" if works else "a required part does not work: see the hints (→) above"
    )
    return "\n".join([*lines, "", closing])


def probe(name: str) -> Part:
    """Test one of the parts in :data:`PROBES`."""
    use, hint, required = PROBES[name]
    outcome = run_child(__name__, use.__name__, timeout=_TIMEOUT)
    if outcome.fault:
        return Part(name, "failed", required, outcome.fault, hint)
    return Part(name, "ok", required, outcome.answers["found"])


def _python() -> Part:
    free = shutil.disk_usage(Path.cwd()).free
    found = f"{platform.python_version()} on {platform.platform(terse=True)}, {sys.executable}; "
    return Part("Python", "ok", True, f"{found}{free / 1e9:.1f} GB free in {Path.cwd()}")


def _llvm() -> Part:
    library = chosen_llvm()
    # Tested again: a cached result does not show the state of today.
    outcome = prove(CPU_VARIANT)
    if not outcome.fault:
        numbers = ".".join(str(n) for n in outcome.answers["llvm"])
        origin = "set by the user"
        if library is None or library == str(shipped_llvm()):
            origin = "of the system" if library is None else "of the installation"
        found = f"{numbers} {origin}, ran test kernels, {library or 'found by Dr.Jit'}"
        return Part("LLVM", "ok", True, found)
    try:
        check_llvm()
    except EngineError as error:
        fault = f"{error.where}: {error.what}" if error.where else error.what
        return Part("LLVM", "failed", True, fault, error.hint)
    return Part("LLVM", "failed", True, outcome.fault, f"{_REINSTALL} karellen-llvm-core")


def _cuda() -> Part:
    outcome = prove(CUDA_VARIANT)
    if outcome.fault:
        return Part("CUDA", "absent", False, f"{outcome.fault}; the CPU is used")
    return Part("CUDA", "ok", False, "ran test kernels")


# The functions below run in child processes.


def use_mitsuba() -> Iterator[Found]:
    """Mitsuba renders a sphere: a convex body of albedo 0.5 under constant radiance 1 has radiance 0.5."""
    mi = load_mitsuba(CPU_VARIANT)
    import drjit as dr

    look_at = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    scene = {
        "type": "scene",
        "integrator": {"type": "path"},
        "light": {"type": "constant"},
        "shape": {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": 0.5}},
        "sensor": {"type": "orthographic", "to_world": look_at.scale([0.5, 0.5, 1]), "film": film},
    }
    mean = float(dr.mean(mi.render(mi.load_dict(scene), spp=16).array)[0])
    if not abs(mean - 0.5) < 0.01:
        raise EngineError(f"a test image has the mean {mean:.3f} instead of 0.5")
    yield {
        "found": f"{version('mitsuba')} with Dr.Jit {version('drjit')}, rendered a test image with "
        f"{dr.thread_count()} threads"
    }


def use_torch() -> Iterator[Found]:
    """PyTorch takes a derivative."""
    # By name: this package does not depend on PyTorch, but the fitter in the same installation does.
    torch: Any = import_module("torch")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    weight = torch.zeros(1, device=device, requires_grad=True)
    (weight - 1).square().sum().backward()
    if weight.grad.item() != -2.0:
        raise EngineError(f"a derivative is {weight.grad.item()} instead of -2")
    yield {"found": f"{torch.__version__} on {device}, took a derivative"}


def use_drawing() -> Iterator[Found]:
    """PyVista draws a sphere off screen."""
    import pyvista

    plotter = pyvista.Plotter(off_screen=True, window_size=[64, 64])
    plotter.set_background("black")
    plotter.add_mesh(pyvista.Sphere(), color="white")
    picture = plotter.screenshot(return_img=True)
    plotter.close()
    if picture is None or not picture.max() > picture.min() + 100:
        raise EngineError("the picture is empty")
    yield {"found": f"pyvista {pyvista.__version__} drew a sphere off screen"}


def use_kernel_cache() -> Iterator[Found]:
    """The folder of compiled kernels is writable."""
    folder = Path(os.environ.get(CACHE_VARIABLE) or "~/.drjit").expanduser()
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=folder, prefix=".doctor-"):
        sizes = [entry.stat().st_size for entry in os.scandir(folder)]
    yield {"found": f"{folder}, {len(sizes)} files, {sum(sizes) / 2**10:.0f} KiB"}


PROBES = {
    "Mitsuba": Probe(use_mitsuba, f"see LLVM; if that works, {_REINSTALL} mitsuba==3.9.1"),
    "PyTorch": Probe(use_torch, f"{_REINSTALL} torch==2.13.0"),
    "Drawing": Probe(
        use_drawing,
        "only 3D pictures need it; install OpenGL (software rendering is enough), on Debian: "
        "apt install libgl1 libegl1 libosmesa6",
        required=False,
    ),
    "Kernel cache": Probe(
        use_kernel_cache,
        f"without it every run compiles its kernels again; make its folder writable or set {CACHE_VARIABLE}",
        required=False,
    ),
}
