"""Paths and URLs that users give: misspelt names, special files, object stores."""

from __future__ import annotations

import difflib
import os
import re
import stat
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from mbtf_core.errors import InputError

_SPECIAL = {stat.S_IFIFO: "pipe", stat.S_IFSOCK: "socket", stat.S_IFCHR: "device", stat.S_IFBLK: "device"}
# Smallest similarity, in [0, 1], of a suggested name.
_LEAST = 0.6
# pathlib joins the slashes of a URL. One letter is the drive of a Windows path.
_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):/{1,3}(.*)", re.DOTALL)


def suggest_path(path: Path, wanted: Callable[[Path], bool] | None = None) -> str:
    """``did you mean 'rock/height.png'?`` for a path that does not exist; empty where no name is similar.

    The first part of the path that does not exist is compared, without regard to case, with what lies beside
    it and is `wanted`; a file of the same stem and another suffix is suggested too.
    """
    parts = [path, *path.parents]
    missing = next((p for p in reversed(parts) if not p.exists()), None)
    if missing is None:
        return ""
    if missing.is_symlink():
        return f"{missing} is a symbolic link to '{os.readlink(missing)}', which leads to no file"
    try:
        beside = sorted(p for p in missing.parent.iterdir() if not p.name.startswith("."))
    except OSError:
        return ""
    # `wanted` applies to the last part of the path only.
    names = {p.name.lower(): p for p in beside if missing != path or wanted is None or wanted(p)}
    near = difflib.get_close_matches(missing.name.lower(), list(names), n=3, cutoff=_LEAST)
    # A common suffix alone does not make names similar.
    stem = missing.stem.lower()
    alike = [n for n in near if difflib.SequenceMatcher(None, stem, Path(n).stem).ratio() >= _LEAST]
    near = alike or [n for n, p in names.items() if p.stem.lower() == stem][:1]
    return f"did you mean '{names[near[0]]}'?" if near else ""


def named_file(folder: Path, name: str) -> Path:
    """Path of a name in a folder, without ``..`` in it; with backslashes as separators, as in Windows, where
    only that exists. A name in the current folder, ``Path()``, stays as it was typed."""
    path = folder / name
    portable = folder / name.replace("\\", "/")
    try:
        if portable != path and not path.exists() and portable.exists():
            path = portable
        # Behind a symbolic link, ``..`` is another folder.
        short = Path(os.path.normpath(path))
        return short if folder != Path() and real_path(short) == real_path(path) else path
    except (OSError, ValueError):
        return path


def suggest_name(given: str, known: Sequence[str], least: float = _LEAST) -> str:
    """``did you mean 'queue'?`` for a name that is not known; empty where no known name has at least the
    similarity `least`."""
    near = difflib.get_close_matches(given, known, n=1, cutoff=least)
    return f"did you mean '{near[0]}'?" if near else ""


def refuse_special(path: Path) -> None:
    """Refuse a pipe, a socket or a device, whose content may never end; a missing file passes."""
    try:
        kind = _SPECIAL.get(stat.S_IFMT(path.stat().st_mode))
    except (OSError, ValueError):
        return
    if kind is not None:
        raise InputError(f"is a {kind}, not a regular file", where=path, hint="save its content in a file")


@contextmanager
def opened(path: Path, wanted: Callable[[Path], bool] | None = None) -> Iterator[BinaryIO]:
    """A regular file to read; what the system refuses, now or while it is read, is an InputError. `wanted` is
    as of :func:`suggest_path`."""
    refuse_special(path)
    try:
        with path.open("rb") as stream:
            yield stream
    except FileNotFoundError:
        raise InputError("no such file", where=path, hint=suggest_path(path, wanted)) from None
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=path) from None


def real_path(path: str | Path) -> Path:
    """The absolute path without symbolic links; unlike ``Path.resolve``, it does not fail at links without an
    end, which whoever opens the file refuses."""
    return Path(os.path.realpath(path))


def split_url(folder: object) -> tuple[str, str] | None:
    """(protocol, rest) of a URL, also of one that pathlib has changed to ``s3:/bucket``; None for a path. The
    rest has the form that pathlib gives it, so that a text and a path name the same folder."""
    match = _URL.fullmatch(str(folder))
    if match is None:
        return None
    return match[1].lower(), "/".join(part for part in match[2].split("/") if part not in ("", "."))
