"""The files of a data set's folder: which are its own, what killed runs leave, and their removal."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from mbtf_core.data.schema import CONFIG_NAME, GEOMETRY_NAME, MANIFEST_NAME, SPLITS
from mbtf_core.data.sidecar import repair_hint
from mbtf_core.errors import PartialError, unwritable
from mbtf_core.files.atomic import TEMPORARY, read_checksummed
from mbtf_core.files.folders import remove_unfinished
from mbtf_core.locks import lock_owner, shard_lock, take_lock

# Files that a run writes, unfinished files that a killed run leaves, and locks.
_SHARD = rf"(?:{'|'.join(SPLITS)})-\d+"
_DOCUMENTS = "|".join(re.escape(name) for name in (MANIFEST_NAME, CONFIG_NAME, GEOMETRY_NAME))
_OWN = re.compile(rf"{_DOCUMENTS}|{_SHARD}\.(?:npz|exr|json)")
_UNFINISHED = re.compile(rf"\.({_OWN.pattern}){TEMPORARY}")
_LOCK = re.compile(rf"\.({_SHARD}|{re.escape(Path(MANIFEST_NAME).stem)})\.lock")


def is_leftover(name: str) -> bool:
    """Whether a file is a lock, or what a killed run left unfinished."""
    return bool(_LOCK.fullmatch(name) or _UNFINISHED.fullmatch(name))


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a folder; an InputError unless it is exactly as it was written."""
    return read_checksummed(folder / MANIFEST_NAME, repair_hint(folder))


def _locks(folder: Path) -> Iterator[Path]:
    """Paths from which :func:`take_lock` finds the locks of a folder."""
    for path in sorted(folder.iterdir()):
        if match := _LOCK.fullmatch(path.name):
            yield folder / f"{match[1]}.npz"


def remove_leftovers(folder: Path) -> None:
    """Remove the locks and unfinished files of killed runs, unless a process holds the lock."""
    general, documents = Path(MANIFEST_NAME).stem, [CONFIG_NAME, GEOMETRY_NAME]
    stems = {path.stem for path in _locks(folder)}
    for path in folder.iterdir():
        if match := _UNFINISHED.fullmatch(path.name):
            stems.add(general if match[1] in documents else Path(match[1]).stem)
    for stem in sorted(stems):
        with shard_lock(folder / f"{stem}.npz") as held:
            if held:
                files = [f"{stem}{suffix}" for suffix in (".npz", ".exr", ".json")]
                remove_unfinished(folder, [*files, *(documents if stem == general else [])])


def clear(folder: Path) -> None:
    """Remove a data set and nothing else, the manifest last, so that shards never remain without it."""
    with ExitStack() as held:
        for path in _locks(folder):
            lock = take_lock(path)
            if lock is None:
                raise PartialError(
                    f"is being written by another process ({lock_owner(path)})",
                    where=folder,
                    hint="wait for it or stop it, then run the same command again",
                )
            held.callback(lock.release)
        files = [f for f in folder.iterdir() if any(p.fullmatch(f.name) for p in (_OWN, _UNFINISHED, _LOCK))]
        try:
            for file in sorted(files, key=lambda file: file.name == MANIFEST_NAME):
                file.unlink(missing_ok=True)
        except OSError as error:
            raise unwritable(folder, error) from None
