"""Output folders: new, empty, resumed, or refused.

A command owns its folder while it writes there. It writes its record first, such as ``manifest.json``: the
folder is then its own, whatever instant the process is killed at.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Callable, Container, Iterator, Mapping
from pathlib import Path
from typing import Any

from mbtf_core.config.nested import differences, in_short
from mbtf_core.errors import InputError, LockedError, PartialError
from mbtf_core.files.atomic import TEMPORARY, remove_file
from mbtf_core.locks import lock_owner, take_lock
from mbtf_core.units import size_text

# Names of temporary files and locks, such as a killed process leaves.
_LEFTOVER = re.compile(rf"\..+(?:{TEMPORARY}|\.lock)")

ELSEWHERE = "choose another folder with -o"


def cache_folder() -> Path:
    """Cache folder: ``$XDG_CACHE_HOME/mbtf``, by default ``~/.cache/mbtf``."""
    return Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "mbtf")


@contextlib.contextmanager
def owned(folder: Path, elsewhere: str = ELSEWHERE) -> Iterator[None]:
    """Own a folder in a block that writes to it, so that no other command does.

    The folder is made if it is missing, and removed again if nothing was written. `elsewhere` names the
    option that chooses another one.

    Raises
    ------
    PartialError : another process owns it, or it cannot be written
    InputError : it cannot be made
    """
    if folder.exists() and not folder.is_dir():
        raise InputError("is a file, not a folder", where=folder)
    made = not folder.exists()
    make_folder(folder)
    try:
        lock = take_lock(folder / "folder")
    except PartialError:
        if made:
            _remove_empty(folder)
        raise
    if lock is None:
        owner = lock_owner(folder / "folder")
        raise LockedError(
            f"is being written by another process{'' if owner is None else f' ({owner})'}",
            where=folder,
            hint=f"wait for it and run the same command again, or {elsewhere}",
        )
    try:
        yield
    finally:
        lock.release()
        if made:
            _remove_empty(folder)


def _remove_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):
        folder.rmdir()


def is_empty(folder: Path) -> bool:
    """Is a folder missing, or empty but for temporary files and locks?"""
    return not folder.exists() or all(_LEFTOVER.fullmatch(p.name) for p in folder.iterdir())


def check_folder(
    folder: Path, is_ours: Callable[[Path], bool], what: str, elsewhere: str = ELSEWHERE
) -> bool:
    """Does an output folder contain a run to resume? False where it is missing or empty.

    Parameters
    ----------
    folder : Path
        The output folder; temporary files and locks in it are ignored.
    is_ours : callable
        Does the folder contain a record of this kind?
    what : str
        Name of the record, for the message.
    elsewhere : str
        Advice that names the option of the folder.

    Returns
    -------
    bool

    Raises
    ------
    InputError
        It is a file, or contains something else.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError("is a file, not a folder", where=folder)
    empty = is_empty(folder)
    # Checked last: another process may write the record meanwhile.
    if is_ours(folder):
        return True
    if not empty:
        raise InputError(f"is not empty and holds no {what}", where=folder, hint=elsewhere)
    return False


def check_space(folder: Path, size: float, hint: str) -> None:
    """Refuse what does not fit on the disk of an output folder.

    Parameters
    ----------
    folder : Path
        The output folder, which may be missing.
    size : float
        Bytes that are to be written.
    hint : str
        The option to change.

    Raises
    ------
    InputError
        Less is free.
    """
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    free = shutil.disk_usage(there).free
    if size > free:
        raise InputError(f"needs {size_text(size)}; {size_text(free)} are free", where=folder, hint=hint)


def make_folder(folder: Path) -> None:
    """Make a folder and those above it, where they are missing.

    Raises
    ------
    InputError : it cannot be made
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be created ({error.strerror})", where=folder) from None


def other_configuration(
    folder: object,
    what: str,
    old: Mapping[str, Any],
    new: Mapping[str, Any],
    otherwise: str = "inputs differ",
) -> InputError:
    """Error for a folder that was written with another configuration.

    Parameters
    ----------
    folder : Path or DataFolder
        For the message.
    what : str
        Content of the folder, for the message.
    old, new : mapping
        Plain data that determine the content: those of the folder, and the requested ones.
    otherwise : str
        Message where these two do not differ.

    Returns
    -------
    InputError
    """
    changes = in_short(differences(old, new)) or otherwise
    return InputError(
        f"holds {what} of another configuration: {changes}",
        where=folder,
        hint=f"{ELSEWHERE}, or replace it with --overwrite",
    )


def remove_unfinished(folder: Path, names: Container[str]) -> None:
    """Remove the temporary files that killed processes left of the files `names`.

    Raises
    ------
    PartialError : the folder cannot be written
    """
    for path in list(folder.iterdir()):
        match = re.fullmatch(rf"\.(.+?){TEMPORARY}", path.name)
        if match is not None and match[1] in names:
            remove_file(path)
