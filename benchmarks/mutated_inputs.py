"""What the readers make of inputs with mutations.

    python benchmarks/mutated_inputs.py [--seed N] [--count N] [--only KIND ...] [--keep FOLDER]

Small meshes, curves, texture sets, measured BTFs and YAML files are made here, each with random features and
faults. A maker knows what a right reading is, by its own arithmetic. A reading is

- ``right``; ``refused`` in at most two lines; ``undecided``: damaged bytes were read, and nobody knows;
- ``wrong``: read as something else without a warning, or read although the format forbids it;
- ``traceback``: an exception that is not ours, or a message of more than two lines;
- ``slow``: over 30 s of processor time; ``large``: over 2 GiB.

``refused valid`` counts the refusals of inputs that the formats allow. ``--keep`` stores the inputs that are
read badly, one folder each. The last line is one JSON object.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import tempfile
import threading
import time
import traceback
import warnings
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from common import finish, parser_of, start
from mutations import archives, bombs, curves, documents, gltf, images, textures, triangles
from mutations.case import Case, Draws, Maker, damaged

from mbtf_core.errors import MbtfError, reason

MAKERS: dict[str, Maker] = {
    "gltf": gltf.make,
    "obj": triangles.obj,
    "ply": triangles.ply,
    "textures": textures.make,
    "images": images.make,
    "curves": curves.make,
    "measured": archives.make,
    "yaml": documents.make,
}
DAMAGED = {f"damaged {name}": damaged(maker) for name, maker in MAKERS.items()}
KINDS = {**MAKERS, **DAMAGED, "bombs": bombs.make}
BAD = ("wrong", "traceback", "slow", "large")
SECONDS, BYTES = 30.0, 2 << 30
WORKERS = 2


def classified(case: Case) -> tuple[str, str]:
    """(class, detail) of one input."""
    from mbtf_gen.tile.loading import load_material

    result: Any
    try:
        if case.path.suffix in archives.SUFFIXES:
            result, said = archives.read(case.path), ""
        else:
            result = load_material(case.path)
            parts = (result.warnings, result.notes, result.unused, result.unused.values())
            said = " ".join(str(text) for part in parts for text in part)
            said = f"{said} {' '.join(result.warnings_in_use())}".lower()
        right = not case.refuse and case.check(result)
    except MbtfError as error:
        if error.message.count("\n") > 1 or len(error.message) > 1000:
            return "traceback", f"a message of {len(error.message)} characters: {error.message[:300]}"
        return "refused valid" if case.valid else "refused", reason(error)
    except MemoryError:
        return "large", "MemoryError"
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{Path(last.filename).name}:{last.lineno}"
        return "traceback", f"{type(error).__name__}: {reason(error)} ({place})"
    told = any(word.lower() in said for word in case.tell)
    if case.refuse:
        return "wrong", "was read"
    if case.tell and not told and not (case.unless and right):
        return "wrong", f"no word about {case.tell[0]}"
    if right is None:
        return "undecided", ""
    # What is said not to be used may change the values.
    return ("right", "") if right or told else ("wrong", "other values")


def work(pipe: Connection) -> None:
    """Make and read inputs, one after the other, as the other end asks."""
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    warnings.simplefilter("ignore")
    while (asked := pipe.recv()) is not None:
        kind, seed, folder = asked
        folder.mkdir()
        draws = Draws(np.random.default_rng(seed), seed[-1])
        case = KINDS[kind](draws, folder)
        pipe.send(", ".join(filter(None, draws.words)))
        began = time.process_time()
        found = classified(case)
        seconds = time.process_time() - began
        pipe.send((*(("slow", "") if seconds > SECONDS else found), seconds))


class Worker:
    """A process that reads inputs, watched from here."""

    def __init__(self) -> None:
        self.pipe, other = multiprocessing.Pipe()
        context = multiprocessing.get_context("spawn")
        self.process = context.Process(target=work, args=(other,), daemon=True)
        self.process.start()
        other.close()

    def read(self, kind: str, seed: list[int], folder: Path) -> dict[str, Any]:
        """The reading of one input; the process ends if that takes too long or too much."""
        self.pipe.send((kind, seed, folder))
        row = {"kind": kind, "seed": seed, "text": self.pipe.recv(), "seconds": 0.0, "MiB": 0}
        began = time.perf_counter()
        try:
            while not self.pipe.poll(0.005):
                pages = Path(f"/proc/{self.process.pid}/statm").read_text().split()[1]
                row["MiB"] = max(row["MiB"], int(pages) * os.sysconf("SC_PAGE_SIZE") >> 20)
                if row["MiB"] > BYTES >> 20 or time.perf_counter() - began > 4 * SECONDS:
                    self.process.kill()
                    self.process.join()
                    name = "large" if row["MiB"] > BYTES >> 20 else "slow"
                    return row | {"class": name, "detail": "", "seconds": time.perf_counter() - began}
            name, detail, seconds = self.pipe.recv()
            return row | {"class": name, "detail": detail, "seconds": seconds}
        except (EOFError, OSError):
            return row | {"class": "traceback", "detail": "the process ended"}


def main() -> int:
    """Read all inputs and count the classes."""
    parser = parser_of(__doc__)
    parser.add_argument("--seed", type=int, default=1, help="seed of all random choices")
    parser.add_argument("--count", type=int, default=100, help="inputs of each kind, a third of them damaged")
    parser.add_argument("--first", type=int, default=0, help="number of the first input of each kind")
    parser.add_argument("--only", nargs="+", choices=KINDS, help="kinds; default: all")
    parser.add_argument("--keep", type=Path, help="folder for the inputs that are read badly")
    parser.add_argument("--show", nargs="+", default=BAD, help="classes that are printed and kept")
    options = parser.parse_args()
    kinds = options.only or list(KINDS)
    counts = dict.fromkeys(MAKERS, options.count) | dict.fromkeys(DAMAGED, -(-options.count // 3))
    counts["bombs"] = min(len(bombs.BOMBS), options.count)
    # Those that unfold first, as they take longest.
    jobs = [
        (kind, [options.seed, list(KINDS).index(kind), options.first + n])
        for kind in sorted(kinds, key=lambda kind: kind != "bombs")
        for n in range(counts[kind])
    ]
    own, workers = threading.local(), list[Worker]()

    def read(job: tuple[str, list[int]]) -> dict[str, Any]:
        if not hasattr(own, "worker") or not own.worker.process.is_alive():
            own.worker = Worker()
            workers.append(own.worker)
        place = Path(folder, "-".join(map(str, job[1])))
        row: dict[str, Any] = own.worker.read(*job, place)
        if row["class"] in options.show or job[0] == "bombs":
            used = f"{row['seconds']:.1f} s, {row['MiB']} MiB"
            print(f"{job}: {row['class']} in {used}: {row['detail']} [{row['text']}]", flush=True)
            if options.keep is not None and place.exists():
                name = f"{job[0]} {place.name} {row['class']}"
                shutil.copytree(place, options.keep / name, dirs_exist_ok=True)
        shutil.rmtree(place, ignore_errors=True)
        return row

    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(WORKERS) as pool:
        rows = list(pool.map(read, jobs))
        for worker in workers:
            if worker.process.is_alive():
                worker.pipe.send(None)
    figures: dict[str, Any] = {"inputs": len(rows), "seconds": round(time.perf_counter() - began, 1)}
    for kind in kinds:
        figures[kind] = dict(Counter(row["class"] for row in rows if row["kind"] == kind).most_common())
        print(f"{kind:<16} {counts[kind]:>4} {json.dumps(figures[kind])}")
    total = Counter(row["class"] for row in rows)
    figures |= {"all": dict(total), **{name: total[name] for name in BAD}}
    return finish(figures, dict.fromkeys(BAD, 0), not any(total[name] for name in BAD))


if __name__ == "__main__":
    start(main)
