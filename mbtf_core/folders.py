"""Output folders: new, empty, resumed, or refused.

A command writes its record first, such as ``manifest.json``: the folder is then its own, whatever instant the
process is killed at.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Container, Mapping
from pathlib import Path
from typing import Any

from mbtf_core.atomic import TEMPORARY, remove_file
from mbtf_core.config_file import differences, in_short
from mbtf_core.errors import InputError

# Names of temporary files and locks, such as a killed process leaves.
_LEFTOVER = re.compile(rf"\..+(?:{TEMPORARY}|\.lock)")

ELSEWHERE = "choose another folder with -o"


def check_folder(folder: Path, is_ours: Callable[[Path], bool], what: str) -> bool:
    """Does an output folder contain a run to resume? False where it is missing or empty.

    Parameters
    ----------
    folder : Path
        The output folder; temporary files and locks in it are ignored.
    is_ours : callable
        Does the folder contain a record of this kind?
    what : str
        Name of the record, for the message.

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
    empty = not folder.exists() or all(_LEFTOVER.fullmatch(p.name) for p in folder.iterdir())
    # Checked last: another process may write the record meanwhile.
    if is_ours(folder):
        return True
    if not empty:
        raise InputError(f"is not empty and holds no {what}", where=folder, hint=ELSEWHERE)
    return False


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
    folder: Path, what: str, old: Mapping[str, Any], new: Mapping[str, Any], otherwise: str = "inputs differ"
) -> InputError:
    """Error for a folder that was written with another configuration.

    Parameters
    ----------
    folder : Path
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
