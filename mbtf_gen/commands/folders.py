"""``mbtf-gen merge`` and ``verify``: folders of shards that exist."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from ..console import CONSOLE, Console
from ..errors import EXIT_BAD_INPUT, EXIT_OK
from .generate import describe


def merge(folder: Path, /, *, console: Console = CONSOLE) -> int:
    """Complete the manifest of a folder that slices (--shards i/n) were written into.

    Parameters
    ----------
    folder
        Folder of shards.
    """
    from ..dataset import Dataset
    from ..errors import EXIT_PARTIAL
    from ..summary import finish, summary_dict

    Dataset.open(folder)
    summary = finish(folder)
    console.report(summary_dict(summary), describe(summary, ran=False))
    return EXIT_OK if summary.complete else EXIT_PARTIAL


def verify(folder: Path, /, *, console: Console = CONSOLE) -> int:
    """Check every shard of a data set against its digest and the manifest.

    Parameters
    ----------
    folder
        Folder of shards.
    """
    from ..dataset import Dataset
    from ..verification import verify

    faults = verify(folder)
    dataset = Dataset.open(folder)
    count = sum(len(s["shards"]) for s in dataset.manifest["splits"].values())
    lines = [f"{folder / f.file}: {f.what}; {f.cure}" for f in faults if not f.absent]
    if absent := [f for f in faults if f.absent]:
        missing = f"{len(absent)} of {count} shards are missing, first {absent[0].file}"
        lines.insert(0, f"{folder}: {missing}; {absent[0].cure}")
    data = {"folder": folder, "shards": count, "faults": [asdict(f) for f in faults]}
    console.report(data, "\n".join(lines) or f"{folder}: {count} shards, all intact")
    return EXIT_BAD_INPUT if faults else EXIT_OK
