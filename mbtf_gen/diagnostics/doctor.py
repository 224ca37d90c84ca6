"""Diagnosis of the machine: each part is used in a child process, and each failure comes with a hint.

A part fails by aborting or hanging as often as by an exception, therefore in a child process
(:mod:`mbtf_core.child_process`).
"""

from __future__ import annotations

import contextlib
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

from mbtf_core.child_process import run_child
from mbtf_core.errors import EXIT_BAD_INPUT, EXIT_OK, EngineError
from mbtf_gen.engine.llvm import CACHE_VARIABLE, chosen_llvm, shipped_llvm, use_shipped_llvm
from mbtf_gen.engine.runtime import CPU_VARIANT, CUDA_VARIANT, check_llvm, load_mitsuba, prove

Found = dict[Literal["found"], str]

# Names of the browser that the tests of the report drive.
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
# Seconds; first starts from a slow network disk take tens of them.
_TIMEOUT = 180.0
# Bytes below which free disk and memory are reported: the demo needs about half as much.
_LITTLE_DISK, _LITTLE_MEMORY = 1e9, 2e9
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
    tests = [_python, _disk, _memory, _llvm, _cuda, _browser, *(partial(probe, name) for name in PROBES)]
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
    if exit_code(parts) != EXIT_OK:
        closing = "a required part does not work: see the hints (→) above"
    elif any(p.state == "failed" for p in parts):
        closing = "every required part works; some optional ones do not (→)"
    else:
        closing = "everything works"
    return "\n".join([*lines, "", closing])


def probe(name: str) -> Part:
    """Test one of the parts in :data:`PROBES`."""
    use, hint, required = PROBES[name]
    outcome = run_child(__name__, use.__name__, timeout=_TIMEOUT)
    if outcome.fault:
        return Part(name, "failed", required, outcome.fault, hint)
    return Part(name, "ok", required, outcome.answers["found"])


def _python() -> Part:
    found = f"{platform.python_version()} on {platform.platform(terse=True)}, {sys.executable}"
    return Part("Python", "ok", True, found)


def _disk() -> Part:
    folders = {str(Path.cwd()): "", tempfile.gettempdir(): " (temporary files)"}
    free = {folder: shutil.disk_usage(folder).free for folder in folders}
    found = ", ".join(f"{free[folder] / 1e9:.1f} GB free in {folder}{use}" for folder, use in folders.items())
    if min(free.values()) < _LITTLE_DISK:
        return Part("Disk", "failed", False, found, "free some, or write elsewhere with -o")
    return Part("Disk", "ok", False, found)


def _memory() -> Part:
    """Memory that is free, by the system and by the limit of a container."""
    try:
        pages = (line.split() for line in Path("/proc/meminfo").read_text().splitlines())
        sizes = {words[0]: 1024.0 * int(words[1]) for words in pages}
        free, total = sizes["MemAvailable:"], sizes["MemTotal:"]
    except (OSError, ValueError, KeyError, IndexError):
        return Part("Memory", "absent", False, "this system does not state it")
    found = f"{free / 1e9:.1f} GB free of {total / 1e9:.1f} GB"
    with contextlib.suppress(OSError, ValueError):
        limit = float(Path("/sys/fs/cgroup/memory.max").read_text())
        free, found = min(free, limit), f"{found}, limited to {limit / 1e9:.1f} GB"
    if free < _LITTLE_MEMORY:
        return Part("Memory", "failed", False, found, "end other programs, or fit with --memory")
    return Part("Memory", "ok", False, found)


def _browser() -> Part:
    browser = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    driver = shutil.which("chromedriver")
    missing = [name for name, path in (("chromium", browser), ("chromedriver", driver)) if path is None]
    if not missing:
        return Part("Browser", "ok", False, f"{browser} with {driver}")
    return Part(
        "Browser",
        "absent",
        False,
        f"no {' and no '.join(missing)}; only tests of the report need them",
        "on Debian: apt install chromium chromium-driver",
    )


def _llvm() -> Part:
    library = chosen_llvm()
    # Tested again: a cached result does not show the state of today.
    outcome = prove(CPU_VARIANT)
    if not outcome.fault:
        version, shipped = ".".join(str(n) for n in outcome.answers["llvm"]), shipped_llvm()
        if library is None:
            origin = "of the system"
        else:
            origin = "of the installation" if library == str(shipped) else "set by the user"
        found = f"{version} {origin}, ran test kernels, {library or 'found by Dr.Jit'}"
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
    """Mitsuba renders a sphere."""
    from importlib.metadata import version

    mi = load_mitsuba(CPU_VARIANT)
    import drjit as dr

    look_at = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path"},
            "light": {"type": "constant"},
            "shape": {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": 0.5}},
            "sensor": {
                "type": "orthographic",
                "to_world": look_at.scale([0.5, 0.5, 1]),
                "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
            },
        }
    )
    mean = float(dr.mean(mi.render(scene, spp=16).array)[0])
    # A convex body of albedo 0.5 under a constant light of radiance 1.
    if not abs(mean - 0.5) < 0.01:
        raise EngineError(f"a test image has the mean {mean:.3f} instead of 0.5")
    yield {"found": f"{version('mitsuba')} with Dr.Jit {version('drjit')}, rendered a test image"}


def use_threads() -> Iterator[Found]:
    """A sum over many lanes is right."""
    mi = load_mitsuba(CPU_VARIANT)
    import drjit as dr

    count = 1 << 22
    total = dr.sum(dr.select(dr.arange(mi.UInt32, count) % 2 == 0, mi.UInt32(1), 0))[0]
    if total != count // 2:
        raise EngineError("a parallel sum is wrong")
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    yield {"found": f"{dr.thread_count()} render threads on {processors} processors{_processor_quota()}"}


def _processor_quota() -> str:
    """Processor time that a container may use, in processors; empty without such a limit."""
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
        return f", limited to the time of {int(quota) / int(period):g}"
    except (OSError, ValueError):
        return ""


def use_torch() -> Iterator[Found]:
    """PyTorch takes a training step."""
    # By name: this package does not depend on PyTorch, but the fitter in the same installation does.
    from importlib import import_module

    torch: Any = import_module("torch")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    weight = torch.zeros(1, device=device, requires_grad=True)
    optimizer = torch.optim.SGD([weight], lr=0.25)
    loss = (weight - 1).square().sum()
    loss.backward()
    optimizer.step()
    if abs(weight.item() - 0.5) > 1e-6:
        raise EngineError(f"a training step gave {weight.item()} instead of 0.5")
    yield {"found": f"{torch.__version__} on {device}, took a training step"}


def use_openexr() -> Iterator[Found]:
    """OpenEXR writes and reads an image."""
    from importlib.metadata import version

    import numpy as np
    import OpenEXR

    image = np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4)
    with tempfile.TemporaryDirectory(prefix="mbtf-doctor-") as folder:
        path = str(Path(folder, "test.exr"))
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"Y": image}).write(path)
        with OpenEXR.File(path, separate_channels=True) as file:
            if not np.array_equal(file.channels()["Y"].pixels, image):
                raise EngineError("an image came back changed")
    yield {"found": f"{version('OpenEXR')}, wrote an image and read it back"}


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
    folder = os.environ.get(CACHE_VARIABLE) or str(Path("~/.drjit").expanduser())
    Path(folder).mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=folder, prefix=".doctor-") as stream:
        stream.write(b"mbtf")
        stream.flush()
    sizes = [entry.stat().st_size for entry in os.scandir(folder)]
    yield {"found": f"{folder}, {len(sizes)} files, {sum(sizes) / 2**10:.0f} KiB"}


PROBES = {
    "Mitsuba": Probe(use_mitsuba, f"see LLVM; if that works, {_REINSTALL} mitsuba==3.9.1"),
    "Threads": Probe(use_threads, "see LLVM"),
    "PyTorch": Probe(use_torch, f"{_REINSTALL} torch==2.13.0"),
    "OpenEXR": Probe(
        use_openexr,
        f"{_REINSTALL} OpenEXR; make sure that the temporary folder ({tempfile.gettempdir()}) can be written",
    ),
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
