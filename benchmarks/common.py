"""What benchmarks share: materials, alternating measurements, stored figures, and the last line."""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from mbtf_core.errors import MbtfError
from mbtf_core.files.atomic import read_json, write_json

ROOT = Path(__file__).resolve().parents[1]
# Scripts use the tests' tools, the package `support`: χ² tests, shapes of unmodified Mitsuba, killed runs.
sys.path.insert(0, str(ROOT / "tests"))
ASSETS = ROOT / "assets"
# Texture sets are not part of the project; benchmarks skip those that are missing.
TEXTURE_SETS = Path(os.environ.get("MBTF_TEXTURE_SETS", ROOT.parent / "shared" / "data" / "materials"))
RELIEFS = ("cliff_rock", "insulation_foam", "straight_wool", "turtle_shell", "twisted_wool")
CLOTHS = ("basket_weave", "twill_silk", "stockinette")
# Height scale of each texture set, exaggerated where the structure is fine.
HEIGHT_SCALES: dict[str, float] = {
    "knit_fabric": 0.05,
    "leather_fine": 0.02,
    "metal_plate": 0.05,
    "rock_cliff": 0.12,
    "stone_bricks": 0.06,
    "tree_bark": 0.1,
}


def source(name: str) -> tuple[Path, float | None]:
    """Folder of a material, and its height scale; None for the material's own."""
    if name in HEIGHT_SCALES:
        return TEXTURE_SETS / name, HEIGHT_SCALES[name]
    return ASSETS / name, None


def is_available(name: str) -> bool:
    """Whether a material is on this machine; if not, says so."""
    folder = source(name)[0]
    if not folder.exists():
        print(f"{name}: skipped, {folder} is missing", file=sys.stderr)
    return folder.exists()


def parser_of(description: str | None) -> argparse.ArgumentParser:
    """A parser whose help is the docstring of a script."""
    formatter = argparse.RawDescriptionHelpFormatter
    return argparse.ArgumentParser(description=description, formatter_class=formatter)


def timed(act: Callable[[], Any]) -> float:
    """Wall seconds of a call."""
    start = time.perf_counter()
    act()
    return time.perf_counter() - start


def watched(command: list[str], out: Path) -> tuple[float, float, float]:
    """(peak memory in GiB, seconds to the first shard, seconds in all) of a run that writes shards to `out`.

    Raises
    ------
    SystemExit : the run failed
    """
    start, first = time.perf_counter(), float("nan")
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as child:
        while True:
            done, status, usage = os.wait4(child.pid, os.WNOHANG)
            if first != first and (out / "train-00000.json").exists():
                first = time.perf_counter() - start
            if done:
                break
            time.sleep(0.01)
        child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise SystemExit(f"failed: {' '.join(command)}")
    return usage.ru_maxrss / 2**20, first, time.perf_counter() - start


def alternate(ways: Mapping[str, Callable[[int], Any]], rounds: int) -> dict[str, list[float]]:
    """Seconds of each way in each round.

    The ways take turns, so that other work on the machine slows all of them. A first round, which
    compiles kernels, is not counted. Each way is called with the number of its round, from 0.
    """
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for number in range(rounds + 1):
        for name, way in ways.items():
            start = time.perf_counter()
            way(number)
            if number:
                seconds[name].append(time.perf_counter() - start)
    return seconds


def kept(path: Path, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Figures of a file; measured and stored where the file is missing, so that a benchmark resumes."""
    if not path.exists():
        write_json(path, measure())
    return dict(read_json(path))


def conformance_deviation(evaluator: Any, stored: Any) -> float:
    """Largest deviation from the conformance values, as a share of max(value, mean)."""
    import numpy as np

    expected = stored.conformance["rgb"]
    found = evaluator.evaluate(*(stored.conformance[name] for name in ("u", "sigma", "omega_i", "omega_o")))
    return float((np.abs(found - expected) / np.maximum(expected, max(expected.mean(), 1e-9))).max())


def processor() -> str:
    """Name of the processor, and the number of its cores that this process may use."""
    try:
        found = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text("utf-8"), re.MULTILINE)
    except OSError:
        found = None
    name = found[1] if found else platform.processor() or platform.machine()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{name}, {cores} cores"


def finish(figures: Any, thresholds: Mapping[str, Any], met: bool | None) -> int:
    """Print the last line, one JSON object, and give the exit code.

    Parameters
    ----------
    figures : what was measured
    thresholds : what the figures are held to, by name
    met : None where the thresholds do not apply to this machine
    """
    line = {"figures": figures, "thresholds": thresholds, "met": met, "processor": processor()}
    print(json.dumps(line))
    return 1 if met is False else 0


def start(main: Callable[[], int]) -> None:
    """Run a script; errors that a user can cause are one line."""
    try:
        sys.exit(main())
    except MbtfError as error:
        print(f"error: {error.message}", file=sys.stderr)
        sys.exit(error.exit_code)
