"""What the readers make of inputs with mutations.

    python benchmarks/mutated_inputs.py [--seed N] [--count N] [--only KIND ...] [--keep FOLDER]

Small meshes, curves, texture sets, measured BTFs and YAML files are made here, each with random features and
faults. A maker knows what a right reading is, by its own arithmetic or another library. A reading is

- ``right``; ``refused`` in at most two lines; ``undecided``: damaged bytes were read, and nobody knows;
- ``wrong``: read as something else without a warning, or read although the format forbids it;
- ``traceback``: an exception that is not ours; ``noise``: another library writes to standard error;
- ``slow``: over 30 s of processor time; ``large``: over 2 GiB.

``refused valid`` counts the refusals of inputs that the formats allow. ``--keep`` stores the inputs that are
read badly, one folder each. The last line is one JSON object.
"""

from __future__ import annotations

import contextlib
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
from collections.abc import Collection, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from common import finish, parser_of, start
from mutations import archives, bombs, curves, documents, gltf, textures, triangles
from mutations.case import Case

from mbtf_core.errors import MbtfError, reason

KINDS = {
    "gltf": gltf.make,
    "gltf bytes": gltf.damage,
    "obj": triangles.obj,
    "ply": triangles.ply,
    "ply bytes": triangles.damage,
    "textures": textures.named,
    "images": textures.numbers,
    "image bytes": textures.damage,
    "curves": curves.make,
    "curve bytes": curves.damage,
    "yarns": curves.pattern,
    "measured": archives.make,
    "measured bytes": archives.damage,
    "yaml": documents.make,
    "bombs": bombs.make,
}
BAD = ("wrong", "traceback", "noise", "slow", "large")
SECONDS, BYTES = 30.0, 2 << 30
WORKERS = 2


def read(case: Case) -> tuple[Any, str]:
    """(result, what was said) of our reader."""
    if case.path.suffix in archives.SUFFIXES:
        return archives.values(case.path), ""
    from mbtf_gen.tile.loading import load_material

    tile = load_material(case.path)
    said = [*tile.warnings, *tile.notes, *tile.unused, *tile.unused.values(), *tile.warnings_in_use()]
    return tile, " ".join(said).lower()


def classified(case: Case) -> tuple[str, str]:
    """(class, detail) of one input."""
    try:
        result, said = read(case)
    except MbtfError as error:
        if error.message.count("\n") > 1 or len(error.message) > 1000:
            return "noise", f"a message of {len(error.message)} characters: {error.message[:300]}"
        return ("refused valid" if case.valid and not case.refuse else "refused"), reason(error)
    except MemoryError:
        return "large", "MemoryError"
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        return (
            "traceback",
            f"{type(error).__name__}: {reason(error)} ({Path(last.filename).name}:{last.lineno})",
        )
    if case.refuse:
        return "wrong", "was read"
    right = case.check(result)
    told = any(word.lower() in said for word in case.tell)
    if case.tell and not told and not (case.unless and right):
        return "wrong", f"no word about {case.tell[0]}"
    if right is None:
        return "undecided", ""
    # What is said not to be used may change the values.
    return ("right", "") if right or told else ("wrong", "other values")


@contextlib.contextmanager
def diverted(stream: int, path: Path) -> Iterator[None]:
    """Send what libraries write to a stream to a file."""
    kept = os.dup(stream)
    with path.open("wb") as file:
        os.dup2(file.fileno(), stream)
    try:
        yield
    finally:
        os.dup2(kept, stream)
        os.close(kept)


def work(pipe: Connection) -> None:
    """Make and read inputs, one after the other, as the other end asks."""
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    warnings.simplefilter("ignore")
    while (asked := pipe.recv()) is not None:
        kind, seed, folder = asked
        folder.mkdir()
        case = KINDS[kind](np.random.default_rng(seed), folder)
        pipe.send(case.text)
        told = folder.with_suffix(".stderr")
        began = time.process_time()
        with diverted(2, told):
            found = classified(case)
        if (took := time.process_time() - began) > SECONDS:
            found = "slow", f"{took:.0f} s"
        noise = told.read_text(errors="replace").strip()
        if noise and found[0] not in BAD:
            found = "noise", f"{found[0]}; on standard error: {noise[:200]}"
        pipe.send(found)


class Worker:
    """A process that reads inputs, watched from here."""

    def __init__(self) -> None:
        self.pipe, other = multiprocessing.Pipe()
        context = multiprocessing.get_context("spawn")
        self.process = context.Process(target=work, args=(other,), daemon=True)
        self.process.start()
        other.close()

    def memory(self) -> int:
        """Resident bytes of the process."""
        pages = Path(f"/proc/{self.process.pid}/statm").read_text().split()[1]
        return int(pages) * os.sysconf("SC_PAGE_SIZE")

    def finished(self, began: float) -> tuple[str, str] | None:
        """What became of the input, None while it is read."""
        try:
            if self.pipe.poll(0.005):
                kind, detail = self.pipe.recv()
                return kind, detail
            if self.memory() > BYTES:
                return "large", f"{self.memory() >> 20} MiB"
        except (EOFError, OSError):
            return "traceback", f"the process ended with {self.process.exitcode}"
        if time.perf_counter() - began > 4 * SECONDS:
            return "slow", f"over {4 * SECONDS:.0f} s"
        return None


def shared(
    jobs: list[tuple[str, list[int]]], folder: Path, keep: Path | None, shown: Collection[str]
) -> list[dict[str, Any]]:
    """All inputs, read by workers in turn; those of some classes are printed and kept."""
    rows: list[dict[str, Any]] = []
    lock = threading.Lock()
    waiting = iter(jobs)

    def serve() -> None:
        worker = Worker()
        while True:
            with lock:
                job = next(waiting, None)
            if job is None:
                worker.pipe.send(None)
                return
            kind, seed = job
            place = folder / "-".join(map(str, seed))
            worker.pipe.send((kind, seed, place))
            text = worker.pipe.recv()
            began, found = time.perf_counter(), None
            while found is None:
                found = worker.finished(began)
            if found[0] in ("large", "slow") or worker.process.exitcode is not None:
                worker.process.kill()
                worker = Worker()
            with lock:
                rows.append({"kind": kind, "seed": seed, "class": found[0], "detail": found[1], "text": text})
                if found[0] in shown:
                    print(f"{kind} {seed}: {found[0]}: {found[1]} [{text}]", flush=True)
                    if keep is not None and place.exists():
                        shutil.copytree(place, keep / f"{kind} {place.name} {found[0]}", dirs_exist_ok=True)
            shutil.rmtree(place, ignore_errors=True)

    threads = [threading.Thread(target=serve) for _ in range(WORKERS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return rows


def main() -> int:
    """Read all inputs and count the classes."""
    parser = parser_of(__doc__)
    parser.add_argument("--seed", type=int, default=1, help="seed of all random choices")
    parser.add_argument("--count", type=int, default=100, help="inputs of each kind")
    parser.add_argument("--first", type=int, default=0, help="number of the first input of each kind")
    parser.add_argument("--only", nargs="+", choices=KINDS, help="kinds; default: all")
    parser.add_argument("--keep", type=Path, help="folder for the inputs that are read badly")
    parser.add_argument("--show", nargs="+", default=BAD, help="classes that are printed and kept")
    options = parser.parse_args()
    numbers = range(options.first, options.first + options.count)
    names = list(KINDS)
    kinds = options.only or names
    jobs = [(kind, [options.seed, names.index(kind), n]) for n in numbers for kind in kinds]
    # Each small file that unfolds once, first, as they take longest.
    jobs = [j for j in jobs if j[0] != "bombs" or j[1][2] < options.first + bombs.COUNT]
    jobs.sort(key=lambda job: job[0] != "bombs")
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        rows = shared(jobs, Path(folder), options.keep, options.show)
    figures: dict[str, Any] = {"inputs": len(rows), "seconds": round(time.perf_counter() - began, 1)}
    figures |= {"all": dict(Counter(row["class"] for row in rows))}
    for kind in kinds:
        counts = Counter(row["class"] for row in rows if row["kind"] == kind)
        figures[kind] = dict(counts.most_common())
        print(f"{kind:<15} {json.dumps(figures[kind])}")
    bad = sum(figures["all"].get(name, 0) for name in BAD)
    return finish(figures | {"read badly": bad}, {"read badly": 0}, bad == 0)


if __name__ == "__main__":
    start(main)
