"""``mbtf-gen merge``, ``verify`` and ``repair``: folders of shards that exist."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import MovedMaterial
from mbtf_core.errors import EXIT_BAD_INPUT, EXIT_OK, EXIT_PARTIAL
from mbtf_core.run.signals import keep_on_interruption
from mbtf_gen.cli.generate import describe

if TYPE_CHECKING:
    from mbtf_gen.generation.repair import RepairResult


def merge(folder: Path, /, *, console: Console = CONSOLE) -> int:
    """Complete a data set of which all slices (--slice i/n) are done.

    Parameters
    ----------
    folder
        Folder of shards, or its URL.
    """
    from mbtf_gen.generation.manifest import finish

    summary = finish(folder)
    console.report(asdict(summary), describe(summary, ran=False))
    return EXIT_OK if summary.complete else EXIT_PARTIAL


def verify(folder: Path, /, *, console: Console = CONSOLE) -> int:
    """Check every byte of a data set against its checksums.

    Parameters
    ----------
    folder
        Folder of shards, or its URL.
    """
    from mbtf_core.data.dataset import Dataset
    from mbtf_core.data.documents import ABSENT
    from mbtf_core.data.folder import DataFolder
    from mbtf_core.data.schema import GEOMETRY_NAME
    from mbtf_core.data.verify import foreign_files, verify

    data_folder = DataFolder.open(folder)
    faults = verify(data_folder)
    dataset = Dataset.open(data_folder)
    entries = [entry for split in dataset.splits for entry in dataset.entries(split)]
    files, foreign = [entry.file for entry in entries], foreign_files(data_folder, entries)
    absent = [f for f in faults if f.what in ABSENT and f.file in files]
    lines = [f"{data_folder.at(f.file)}: {f.what}; {f.hint}" for f in faults if f not in absent]
    if absent:
        missing = f"{len(absent)} of {len(files)} shards missing, first {absent[0].file}"
        lines.insert(0, f"{data_folder}: {missing}; {absent[0].hint}")
    data: dict[str, Any] = {
        "folder": str(data_folder),
        "shards": len(files),
        "bytes": sum(data_folder.size(file) or 0 for file in files),
        "faults": [asdict(f) for f in faults],
        "foreign": foreign,
    }
    known = "" if dataset.manifest["geometry"] is None else f" and {GEOMETRY_NAME}"
    lines = lines or [f"{data_folder}: {len(files)} shards{known}, all intact"]
    console.report(data, "\n".join([*lines, *_describe_foreign(data_folder, foreign)]))
    return EXIT_BAD_INPUT if faults else EXIT_OK


def repair(folder: Path, /, *, material: MovedMaterial = None, console: Console = CONSOLE) -> int:
    """Generate missing and corrupt files again.

    The data set is then identical to the original.

    Parameters
    ----------
    folder
        Folder of shards, or its URL.
    """
    from mbtf_core.data.folder import DataFolder
    from mbtf_gen.generation.repair import repair as run

    data_folder = DataFolder.open(folder)
    keep_on_interruption(f"{data_folder}: the shards rendered so far are kept")
    with console.progress(None, "repairing", "paths") as bar:
        done = run(data_folder, material=material, progress=bar.update)
    console.report(asdict(done), _describe_repair(done))
    return EXIT_OK if done.complete else EXIT_PARTIAL


def _describe_repair(done: RepairResult) -> str:
    from mbtf_core.data.documents import ABSENT

    lines = [f"{done.folder}/{f.file}: {f.what}" for f in done.faults if f.what not in ABSENT]
    if done.shards:
        first = ", ".join(done.shards[:5]) + (", …" if len(done.shards) > 5 else "")
        lines.append(f"{done.folder}: {len(done.shards)} shards rendered again ({first})")
    if done.documents:
        lines.append(f"{done.folder}: {' and '.join(done.documents)} written again")
    if not done.shards and not done.documents:
        lines.append(f"{done.folder}: nothing to repair")
    return "\n".join(lines)


def _describe_foreign(folder: object, names: list[str]) -> list[str]:
    if not names:
        return []
    shown = ", ".join(names[:5]) + (", …" if len(names) > 5 else "")
    return [f"{folder}: not part of the data set, left alone: {shown}"]
