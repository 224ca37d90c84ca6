"""Output folders: new, empty, resumed, replaced, or refused.

A command owns its folder while it writes there. It writes its record first, such as ``manifest.json``: the
folder is then its own, whatever instant the process is killed at. Files that the record does not list belong
to others and are never touched. Nor is a file that has changed since it was written, unless the user asks to
replace it.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel

from mbtf_core.config.settings import check_document, check_schema, differences, in_short
from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.errors import InputError, LockedError, PartialError, unwritable
from mbtf_core.files.atomic import (
    TEMPORARY,
    Stored,
    data_sha256,
    file_sha256,
    read_json,
    remove_file,
    write_json,
)
from mbtf_core.files.editable import changed, write_document
from mbtf_core.files.locks import lock_owner, take_lock
from mbtf_core.units import size_text

# Names of temporary files and locks, such as a killed process leaves.
_LEFTOVER = re.compile(rf"\..+(?:{TEMPORARY}|\.lock)")

ELSEWHERE = "choose another folder with -o"
# Beside the record: the resolved options, which a command can be given again.
CONFIG_NAME = "config.yaml"


def cache_folder() -> Path:
    """Cache folder: ``$XDG_CACHE_HOME/mbtf``, by default ``~/.cache/mbtf``."""
    return Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "mbtf")


@contextlib.contextmanager
def owned(folder: Path) -> Iterator[None]:
    """Own a folder in a block that writes to it, so that no other command does.

    The folder is made if it is missing, and removed again if nothing was written. A PartialError where
    another process owns it, or it cannot be written; an InputError where it cannot be made.
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
            hint=f"wait for it and run the same command again, or {ELSEWHERE}",
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


def check_folder(folder: Path, is_ours: Callable[[Path], bool], what: str) -> bool:
    """Whether an output folder contains a run to resume, by `is_ours`; False where it is missing or empty. An
    InputError where it is a file, or contains something else; `what` names the output."""
    if folder.exists() and not folder.is_dir():
        raise InputError("is a file, not a folder", where=folder)
    empty = is_empty(folder)
    # Checked last: another process may write the record meanwhile.
    if is_ours(folder):
        return True
    if not empty:
        raise InputError(f"is not empty and holds no {what}", where=folder, hint=ELSEWHERE)
    return False


def check_space(folder: Path, size: float, hint: str) -> None:
    """Refuse output of this size, in bytes, that does not fit on the disk of its folder, which need not exist
    yet; `hint` names the option to change."""
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    free = shutil.disk_usage(there).free
    if size > free:
        raise InputError(f"needs {size_text(size)}; {size_text(free)} are free", where=folder, hint=hint)


def make_folder(folder: Path) -> None:
    """Make a folder and those above it, where they are missing; an InputError where it cannot be made."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be created ({error.strerror})", where=folder) from None


def other_configuration(
    folder: object, what: str, old: Mapping[str, Any], new: Mapping[str, Any]
) -> InputError:
    """Error for a folder, path or URL, that holds `what` of another configuration; `old` and `new` are plain
    data that determine the content: those of the folder, and the requested ones."""
    changes = in_short(differences(old, new)) or "inputs differ"
    return InputError(
        f"holds {what} of another configuration: {changes}",
        where=folder,
        hint=f"{ELSEWHERE}, or replace it with --overwrite",
    )


def remove_unfinished(folder: Path, names: Container[str]) -> None:
    """Remove the temporary files that killed processes left of the files `names`; a PartialError where the
    folder cannot be written."""
    for path in list(folder.iterdir()):
        match = re.fullmatch(rf"\.(.+?){TEMPORARY}", path.name)
        if match is not None and match[1] in names:
            remove_file(path)


def _inside(name: str) -> str:
    """A file name below the folder; a record of others must not lead out of it."""
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\0" in name or not path.name:
        raise ValueError("must lie in the folder")
    return name


_Name = Annotated[str, AfterValidator(_inside)]


class _Item(BaseModel):
    files: dict[_Name, Stored]
    facts: dict[str, Any]


class _Record(BaseModel):
    hash: str
    depends: dict[str, Any]
    listed: list[_Name]
    items: dict[str, _Item] = {}


@dataclass(frozen=True)
class OutputKind:
    """Kind of output, as the record in its folder states it: name of the record's file, its format and
    schema, and the name of the output with its article, for messages."""

    record: str
    format: str
    schema: int
    what: str

    def read(self, folder: Path) -> dict[str, Any] | None:
        """The record of a folder; None where it has none of this kind, an InputError where it has another
        schema version."""
        try:
            found = read_json(folder / self.record)
        except InputError:
            return None
        if found.get("format") != self.format:
            return None
        check_schema(found, self.schema, folder / self.record, ELSEWHERE)
        return found

    def check(self, folder: Path) -> bool:
        """:func:`check_folder` for output of this kind."""
        name = re.sub("^an? ", "", self.what)
        return check_folder(folder, lambda path: self.read(path) is not None, name)

    def write(self, folder: Path, content: Mapping[str, Any]) -> None:
        """Write a record, atomically."""
        write_json(folder / self.record, {"format": self.format, "schema": self.schema, **content})


class OutputFolder:
    """A folder that :meth:`claim` has claimed for one configuration of a command; the caller owns it.

    As a context manager it gives up the claim of a new folder if an error comes before the first file.
    """

    def __init__(self, path: Path, kind: OutputKind, record: _Record, *, new: bool) -> None:
        self.path, self._kind, self._record = path, kind, record
        # The files that tell whose a new folder is.
        self._claim = [kind.record] if new else []

    @classmethod
    def claim(
        cls,
        path: Path,
        kind: OutputKind,
        depends: Mapping[str, Any],
        listed: Iterable[str],
        *,
        config: Mapping[str, Any] | None = None,
        digest: str | None = None,
        overwrite: bool = False,
    ) -> OutputFolder:
        """Claim a folder that is empty, of the same configuration, or to be replaced.

        Parameters
        ----------
        depends, digest : plain data that determine the content; digest of all that does, theirs by default
        listed : names of all files that may be written; when replaced, removed in this order
        config : resolved options, written beside the record

        Raises
        ------
        InputError, PartialError : the folder holds something else; it cannot be written
        """
        new = _Record(hash=digest or data_sha256(depends), depends=dict(depends), listed=list(listed))
        present = kind.check(path)
        folder = cls(path, kind, new, new=not present)
        if present:
            old = check_document(_Record, kind.read(path) or {}, path / kind.record, ELSEWHERE)
            if not overwrite and old.hash != new.hash:
                raise other_configuration(path, kind.what, old.depends, new.depends)
            for below in {path, *((path / name).parent for name in old.listed)}:
                if below.is_dir():
                    remove_unfinished(below, {Path(name).name for name in old.listed})
            if overwrite:
                for name in old.listed:
                    remove_file(path / name)
            else:
                folder._record = old
        make_folder(path)
        remove_unfinished(path, (kind.record, CONFIG_NAME))
        # The record first, also in place of that of a replaced output.
        if folder._record is new:
            folder._save()
        if config is not None:
            if folder._claim:
                folder._claim.insert(0, CONFIG_NAME)
            write_document(path / CONFIG_NAME, dump_yaml(config), overwrite=overwrite)
        return folder

    def __enter__(self) -> OutputFolder:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        failed = kind is not None and issubclass(kind, Exception)
        if failed and not any((self.path / name).exists() for name in self._record.listed):
            for name in self._claim:
                remove_file(self.path / name)

    def _save(self) -> None:
        # In whichever order the items are made, possibly again.
        items = dict(sorted(self._record.items.items()))
        self._kind.write(self.path, self._record.model_copy(update={"items": items}).model_dump())

    def finished(self, name: str, **wanted: Any) -> dict[str, Any] | None:
        """Facts stored by :meth:`keep`, if all files of the item are there as they were written; an
        InputError where one has changed. An item that lacks a file, or has other facts than `wanted`, is to
        be made again."""
        item = self._record.items.get(name)
        if item is None:
            return None
        there = [file for file in item.files if (self.path / file).is_file()]
        for file in there:
            if self._stored(file) != item.files[file]:
                raise changed(self.path / file)
        if len(there) == len(item.files) and wanted.items() <= item.facts.items():
            return item.facts
        # If this process is killed, its files may have other bytes than the record says.
        del self._record.items[name]
        self._save()
        return None

    def _stored(self, file: str) -> Stored:
        path = self.path / file
        try:
            return Stored(path.stat().st_size, file_sha256(path))
        except OSError as error:
            raise unwritable(path, error) from None

    def keep(self, name: str, files: Iterable[Path], facts: Mapping[str, Any]) -> None:
        """Record an item as finished: its files, which lie in the folder, and plain data about it."""
        names = [path.relative_to(self.path).as_posix() for path in files]
        self._keep(name, {file: self._stored(file) for file in names}, facts)

    def _keep(self, name: str, files: dict[str, Stored], facts: Mapping[str, Any]) -> None:
        item = _Item(files=files, facts=dict(facts))
        if self._record.items.get(name) != item:
            self._record.items[name] = item
            self._save()

    def add(self, name: str, write: Callable[[Path], Stored]) -> Stored:
        """Write a file with ``write(path)``, atomically, unless it is finished; its size and digest. An
        InputError where it has changed since it was written, a PartialError where it cannot be written."""
        if self.finished(name) is None:
            path = self.path / name
            if not self.path.is_dir():
                # Made anew, it would lack the files before.
                raise PartialError("has vanished", where=self.path, hint="run the same command again")
            make_folder(path.parent)
            self._keep(name, {name: write(path)}, {})
        return self._record.items[name].files[name]

    def check_added(self, names: Iterable[str]) -> None:
        """A PartialError if a file that was added has vanished meanwhile."""
        for name in names:
            if not (self.path / name).is_file():
                raise PartialError("has vanished", where=self.path / name, hint="run the same command again")
