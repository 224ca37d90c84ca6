"""What this machine can do: each part is used in a child process, each failure names its hint.

A part fails by aborting or hanging as often as by an exception, hence the children (:mod:`mbtf_core.child_process`).
"""

from __future__ import annotations

import os
import platform
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from mbtf_core.child_process import Outcome, run_child
from mbtf_core.errors import EXIT_BAD_INPUT, EXIT_OK, EngineError
from mbtf_gen.render.llvm import CACHE_VARIABLE, chosen_llvm, shipped_llvm, use_shipped_llvm
from mbtf_gen.render.runtime import CPU_VARIANT, CUDA_VARIANT, check_llvm, load_mitsuba, prove

State = Literal["ok", "failed", "absent"]

# Seconds; first starts from a slow network disk take tens of them.
_TIMEOUT = 180.0
_REINSTALL = "install again: pip install --force-reinstall"


@dataclass(frozen=True)
class Check:
    """One part of the machine.

    Attributes
    ----------
    name : the part
    state : ``ok``; ``failed``; ``absent``: not there, and not needed
    required : whether the programs need it
    found : what was found, or what went wrong
    hint : what to do about it; empty where nothing is to be done
    """

    name: str
    state: State
    required: bool
    found: str
    hint: str = ""


def diagnose() -> list[Check]:
    """Try every part, several at a time; takes seconds, never raises."""
    use_shipped_llvm()
    checks: tuple[Callable[[], Check], ...] = (
        _python,
        _llvm,
        _mitsuba,
        _threads,
        _cuda,
        _torch,
        _openexr,
        _drawing,
        _kernel_cache,
    )
    with ThreadPoolExecutor(max_workers=min(4, os.cpu_count() or 1)) as pool:
        return list(pool.map(lambda check: check(), checks))


def exit_code(checks: Sequence[Check]) -> int:
    """0, or 3 when something required failed."""
    return EXIT_BAD_INPUT if any(c.required and c.state != "ok" for c in checks) else EXIT_OK


def as_json(checks: Sequence[Check]) -> dict[str, Any]:
    """Plain data of the diagnosis: ``healthy`` and the list ``checks``."""
    return {"healthy": exit_code(checks) == EXIT_OK, "checks": [asdict(c) for c in checks]}


def as_text(checks: Sequence[Check]) -> str:
    """The diagnosis as a table, cures below what they hint, a closing line."""
    width = max(len(c.name) for c in checks)
    lines = []
    for check in checks:
        lines.append(f"{check.state:<7} {check.name:<{width}}  {check.found}")
        if check.hint:
            lines.append(f"{'':<7} {'':<{width}}  → {check.hint}")
    if exit_code(checks) != EXIT_OK:
        closing = "something that is needed does not work: see the cures (→) above"
    elif any(c.state == "failed" for c in checks):
        closing = "everything needed works; some conveniences do not (→)"
    else:
        closing = "everything works"
    return "\n".join([*lines, "", closing])


def _probe(function: str, *arguments: str) -> Outcome:
    return run_child(__name__, function, *arguments, timeout=_TIMEOUT)


def _result(
    name: str, outcome: Outcome, found: Callable[[dict[str, Any]], str], hint: str, required: bool = True
) -> Check:
    if outcome.fault:
        return Check(name, "failed", required, outcome.fault, hint)
    return Check(name, "ok", required, found(outcome.answers))


def _python() -> Check:
    return _result(
        "Python",
        _probe("_use_python"),
        lambda a: f"{a['version']} on {a['platform']}, {sys.executable}",
        "make a new virtual environment with Python 3.11 or newer",
    )


def _use_python() -> Iterator[dict[str, Any]]:
    yield {"version": platform.python_version(), "platform": platform.platform(terse=True)}


def _llvm() -> Check:
    library = chosen_llvm()
    # Proved anew: a remembered proof says nothing about today.
    outcome = prove(CPU_VARIANT)
    if not outcome.fault:
        shipped = shipped_llvm()
        origin = "of the installation" if shipped and library == str(shipped) else "set by the user"
        if library is None:
            origin = "of the system"
        version = ".".join(str(n) for n in outcome.answers["llvm"])
        return Check(
            "LLVM", "ok", True, f"{version} {origin}, ran test kernels, {library or 'found by Dr.Jit'}"
        )
    try:
        check_llvm()
    except EngineError as error:
        return Check(
            "LLVM", "failed", True, f"{error.where}: {error.what}" if error.where else error.what, error.hint
        )
    return Check("LLVM", "failed", True, outcome.fault, f"{_REINSTALL} karellen-llvm-core")


def _mitsuba() -> Check:
    return _result(
        "Mitsuba",
        _probe("_use_mitsuba"),
        lambda a: f"{a['mitsuba']} with Dr.Jit {a['drjit']}, rendered a test image",
        f"see LLVM; if that is well, {_REINSTALL} mitsuba==3.9.1",
    )


def _use_mitsuba() -> Iterator[dict[str, Any]]:
    from importlib.metadata import version

    mi = load_mitsuba(CPU_VARIANT)
    import drjit as dr

    yield {"mitsuba": version("mitsuba"), "drjit": version("drjit")}
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path"},
            "light": {"type": "constant"},
            "shape": {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": 0.5}},
            "sensor": {
                "type": "orthographic",
                "to_world": mi.ScalarTransform4f()
                .look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
                .scale([0.5, 0.5, 1]),
                "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
            },
        }
    )
    mean = float(dr.mean(mi.render(scene, spp=16).array)[0])
    # A convex body of albedo 0.5 under a constant light of radiance 1.
    if not abs(mean - 0.5) < 0.01:
        raise EngineError(f"a test image has the mean {mean:.3f} instead of 0.5")


def _threads() -> Check:
    return _result(
        "Threads",
        _probe("_use_threads"),
        lambda a: (
            f"{a['threads']} render threads on {a['processors']} processors"
            + (f", limited to the time of {a['quota']:g}" if a["quota"] else "")
        ),
        "see LLVM",
    )


def _use_threads() -> Iterator[dict[str, Any]]:
    mi = load_mitsuba(CPU_VARIANT)
    import drjit as dr

    count = 1 << 22
    total = dr.sum(dr.select(dr.arange(mi.UInt32, count) % 2 == 0, mi.UInt32(1), 0))[0]
    if total != count // 2:
        raise EngineError("a parallel sum is wrong")
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    yield {"threads": dr.thread_count(), "processors": processors, "quota": _processor_quota()}


def _processor_quota() -> float | None:
    """Processors whose time a container may use; None where there is no such limit."""
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
        return int(quota) / int(period)
    except (OSError, ValueError):
        return None


def _cuda() -> Check:
    outcome = prove(CUDA_VARIANT)
    if outcome.fault:
        return Check("CUDA", "absent", False, f"{outcome.fault}; the processor is used")
    return Check("CUDA", "ok", False, "ran test kernels")


def _torch() -> Check:
    return _result(
        "PyTorch",
        _probe("_use_torch"),
        lambda a: f"{a['torch']} on {a['device']}, took a training step",
        f"{_REINSTALL} torch==2.13.0",
    )


def _use_torch() -> Iterator[dict[str, Any]]:
    # By name: this package does not depend on PyTorch, the fitter in the same installation does.
    from importlib import import_module

    torch: Any = import_module("torch")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    yield {"torch": torch.__version__, "device": device}
    weight = torch.zeros(1, device=device, requires_grad=True)
    optimizer = torch.optim.SGD([weight], lr=0.25)
    loss = (weight - 1).square().sum()
    loss.backward()
    optimizer.step()
    if abs(weight.item() - 0.5) > 1e-6:
        raise EngineError(f"a training step gave {weight.item()} instead of 0.5")


def _openexr() -> Check:
    return _result(
        "OpenEXR",
        _probe("_use_openexr"),
        lambda a: f"{a['openexr']}, wrote an image and read it back",
        f"{_REINSTALL} OpenEXR; make sure that the temporary folder ({tempfile.gettempdir()}) can be written",
    )


def _use_openexr() -> Iterator[dict[str, Any]]:
    from importlib.metadata import version

    import numpy as np
    import OpenEXR

    yield {"openexr": version("OpenEXR")}
    image = np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4)
    with tempfile.TemporaryDirectory(prefix="mbtf-doctor-") as folder:
        path = str(Path(folder, "test.exr"))
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"Y": image}).write(path)
        with OpenEXR.File(path, separate_channels=True) as file:
            if not np.array_equal(file.channels()["Y"].pixels, image):
                raise EngineError("an image came back changed")


def _drawing() -> Check:
    return _result(
        "Drawing",
        _probe("_use_drawing"),
        lambda a: f"pyvista {a['pyvista']} drew a sphere off screen",
        "only 3D pictures need it; install OpenGL (software will do), on Debian: "
        "apt install libgl1 libegl1 libosmesa6",
        required=False,
    )


def _use_drawing() -> Iterator[dict[str, Any]]:
    import pyvista

    yield {"pyvista": pyvista.__version__}
    plotter = pyvista.Plotter(off_screen=True, window_size=[64, 64])
    plotter.set_background("black")
    plotter.add_mesh(pyvista.Sphere(), color="white")
    picture = plotter.screenshot(return_img=True)
    plotter.close()
    if picture is None or not picture.max() > picture.min() + 100:
        raise EngineError("the picture is empty")


def _kernel_cache() -> Check:
    folder = os.environ.get(CACHE_VARIABLE) or str(Path("~/.drjit").expanduser())
    return _result(
        "Kernel cache",
        _probe("_use_kernel_cache", folder),
        lambda a: f"{folder}, {a['files']} files, {a['bytes'] / 2**10:.0f} KiB",
        f"without it every run compiles its kernels again: make {folder} writable or set {CACHE_VARIABLE}",
        required=False,
    )


def _use_kernel_cache(folder: str) -> Iterator[dict[str, Any]]:
    Path(folder).mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=folder, prefix=".doctor-") as stream:
        stream.write(b"mbtf")
        stream.flush()
    sizes = [entry.stat().st_size for entry in os.scandir(folder)]
    yield {"files": len(sizes), "bytes": sum(sizes)}
