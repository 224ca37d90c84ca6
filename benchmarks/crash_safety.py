"""Kills runs, damages data sets, and counts what was lost or not found.

    python benchmarks/crash_safety.py [--kills N] [--flips N] [--repairs N] [--rendered N] [--seed N]

- Kills: runs on small shards in child processes, killed in turn at a random file operation, at a random time,
  and at a random time beside a second process on the same folder. The same command goes on until the data set
  is complete; then every file must be that of an undisturbed run, byte for byte but for times.
- Flips: one byte of one file of a data set changed at random; ``verify`` must name the file. Cuts: a file
  truncated at random. Repairs: some of them mended, and compared with the undisturbed data set.
- Rendered: kills at random times of the program itself, with the renderer at work; queries and values must
  be the same bits.

The last line is a JSON object.
"""

from __future__ import annotations

import contextlib
import io
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from common import finish, parser_of, start
from support.file_operations import FileOperations, Operation
from support.small_runs import command, contents, die, ending, generate, in_child, noisy_plane

from mbtf_core.data.documents import ABSENT
from mbtf_core.data.verify import INCOMPLETE, verify
from mbtf_core.errors import InputError
from mbtf_gen.planning.simulation import ClosedForm

KILLED = -signal.SIGKILL


def quietly(act: Callable[[], int]) -> Callable[[], int]:
    """`act` without its output."""

    def silent() -> int:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            return act()

    return silent


def damaged(folder: Path) -> list[str]:
    """Files that are there and are not what they should be, in a folder whose run was killed."""
    if not (folder / "manifest.json").exists():
        return []
    return [f.file for f in verify(folder) if f.what not in (*ABSENT, INCOMPLETE)]


def killed_runs(folder: Path, kills: int, dice: random.Random) -> dict[str, Any]:
    """Kill runs until so many kills have hit."""
    whole, out = folder / "whole", folder / "out"
    line = command(folder, out, train=400)
    start = time.perf_counter()
    with FileOperations(whole) as watch:
        assert quietly(lambda: generate(command(folder, whole, train=400)))() == 0
    seconds, operations = time.perf_counter() - start, len(watch.seen)
    expected = contents(whole)
    counts = {"kills": 0, "finished before": 0, "damaged": 0, "data sets": 0, "different": 0, "refused": 0}

    def at_operation(number: int) -> Callable[[], int]:
        def act() -> int:
            def count(operation: Operation) -> None:
                if len(watch.seen) >= number:
                    die()

            watch = FileOperations(out, count)
            with watch:
                return generate(line)

        return act

    while counts["kills"] < kills:
        kind = counts["kills"] % 3
        if kind == 0:
            codes = [ending(in_child(quietly(at_operation(dice.randrange(1, operations // 2)))))]
        else:
            children = [in_child(quietly(lambda: generate(line))) for _ in range(kind)]
            time.sleep(dice.random() * seconds)
            for child in children[:1]:
                # It is not waited for yet: the number is still its own.
                os.kill(child, signal.SIGKILL)
            codes = [ending(child) for child in children]
        hit = codes[0] == KILLED
        counts["kills" if hit else "finished before"] += 1
        # Beside a process that is killed, the other one completes the data set, or leaves it a shard.
        counts["refused"] += sum(code not in (0, 4, KILLED) for code in codes)
        counts["damaged"] += len(damaged(out))
        if not hit or dice.random() < 0.2 or counts["kills"] == kills:
            code = quietly(lambda: generate(line))()
            counts["refused"] += code != 0
            counts["data sets"] += 1
            counts["different"] += contents(out) != expected
            shutil.rmtree(out)
    return counts


def found(folder: Path, file: str) -> bool:
    """Whether ``verify`` says that something is wrong with a file."""
    try:
        faults = verify(folder)
    except InputError as error:
        return file in str(error.where)
    shard = Path(file).stem
    return any(Path(f.file).stem == shard for f in faults)


def flipped(folder: Path, flips: int, repairs: int, dice: random.Random) -> dict[str, Any]:
    """Change or cut a file at random and look whether it is found; mend some."""
    whole, out = folder / "whole", folder / "out"
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(whole, out)
    expected = contents(whole)
    names = sorted(expected)
    counts = {"flips": 0, "cuts": 0, "missed": 0, "repairs": 0, "not repaired": 0}
    for number in range(flips):
        path = out / dice.choice(names)
        intact = path.read_bytes()
        content = bytearray(intact)
        if number % 10 == 9:
            counts["cuts"] += 1
            del content[dice.randrange(len(content)) :]
        else:
            counts["flips"] += 1
            content[dice.randrange(len(content))] ^= dice.randrange(1, 256)
        path.write_bytes(content)
        if not found(out, path.name):
            counts["missed"] += 1
            print(f"missed: {path.name}", file=sys.stderr)
        if number < repairs:
            counts["repairs"] += 1
            code = quietly(lambda: generate(["repair", str(out), "-q"]))()
            counts["not repaired"] += code != 0 or contents(out) != expected
        path.write_bytes(intact)
    return counts


def rendered(folder: Path, kills: int, dice: random.Random) -> dict[str, Any]:
    """Kill the program while it renders."""
    rng = np.random.default_rng(0)
    np.save(folder / "relief.npy", 0.1 * rng.random((16, 16)))
    arguments = "--queries 4000 --test-queries 500 --test-spp 8 --set output.shard_queries=300 -q"

    def start(name: str) -> subprocess.Popen[bytes]:
        line = [sys.executable, "-m", "mbtf_gen", "relief.npy", *arguments.split(), "-o", name]
        return subprocess.Popen(line, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def shards(name: str) -> dict[str, bytes]:
        return {p.name: p.read_bytes() for p in (folder / name).glob("*.npz")}

    assert start("rendered").wait() == 0
    began = time.perf_counter()
    assert start("again").wait() == 0
    seconds = time.perf_counter() - began
    counts = {"kills": 0, "data sets": 0, "different": int(shards("again") != shards("rendered"))}
    while counts["kills"] < kills or (folder / "killed").exists():
        process = start("killed")
        if counts["kills"] < kills:
            time.sleep(seconds * (0.5 + 0.6 * dice.random()))
            process.kill()
        if process.wait() == KILLED:
            counts["kills"] += 1
            counts["different"] += len(damaged(folder / "killed"))
            continue
        counts["data sets"] += 1
        counts["different"] += shards("killed") != shards("rendered") or bool(verify(folder / "killed"))
        shutil.rmtree(folder / "killed")
    return counts


def main() -> int:
    parser = parser_of(__doc__)
    for name, default in (("kills", 500), ("flips", 10_000), ("repairs", 200), ("rendered", 20), ("seed", 0)):
        parser.add_argument(f"--{name}", type=int, default=default)
    options = parser.parse_args()
    dice = random.Random(options.seed)
    ClosedForm.estimate = noisy_plane  # type: ignore[method-assign, assignment]
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        steps: dict[str, Callable[[], dict[str, Any]]] = {
            "killed": lambda: killed_runs(folder, options.kills, dice),
            "damaged": lambda: flipped(folder, options.flips, options.repairs, dice),
            "rendered": lambda: rendered(folder, options.rendered, dice),
        }
        for step, run in steps.items():
            start = time.perf_counter()
            figures[step] = run()
            figures[step]["seconds"] = round(time.perf_counter() - start, 1)
            print(f"{step}: {figures[step]}", file=sys.stderr)
    bad = ("damaged", "different", "refused", "missed", "not repaired")
    lost = sum(counts.get(name, 0) for counts in figures.values() for name in bad)
    figures["lost or not found"] = lost
    return finish(figures, {"lost or not found": 0}, lost == 0)


if __name__ == "__main__":
    start(main)
