"""The folder of a published data set: claimed, resumed, or replaced.

``publish.json`` is its record: what the folder was made from, and the finished files with their sizes and
digests. Files that the record does not list belong to others and are never touched.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel

from mbtf_core.config.settings import check_document
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import Stored, read_json, remove_file, write_json
from mbtf_core.files.digest import data_sha256
from mbtf_core.files.folders import (
    ELSEWHERE,
    check_folder,
    make_folder,
    other_configuration,
    remove_unfinished,
)

RECORD_NAME = "publish.json"
_FORMAT, _VERSION = "mbtf-publication", 1


def _inside(name: str) -> str:
    """A file name below the folder; a record of others must not lead out of it."""
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\0" in name or not path.name:
        raise ValueError("must lie in the folder")
    return name


class _File(BaseModel):
    bytes: int
    sha256: str


class _Record(BaseModel):
    """Content of ``publish.json``."""

    hash: str
    depends: dict[str, Any]
    listed: list[Annotated[str, AfterValidator(_inside)]]
    files: dict[Annotated[str, AfterValidator(_inside)], _File]


@dataclass
class PublishFolder:
    """A folder that was claimed by :meth:`claim`; the caller owns it.

    Attributes
    ----------
    path : Path
        The folder.
    record : dict
        Content of its ``publish.json``.
    """

    path: Path
    record: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def claim(
        cls, path: Path, depends: Mapping[str, Any], listed: list[str], *, overwrite: bool = False
    ) -> PublishFolder:
        """Claim a folder that is empty, of the same content, or to be replaced.

        Parameters
        ----------
        path : Path
            The folder, which the caller owns.
        depends : mapping
            Plain data that determine its content.
        listed : list of str
            Names of all files that may be written, relative to the folder.
        overwrite : bool
            Remove what the folder's record lists, and start anew.

        Returns
        -------
        PublishFolder

        Raises
        ------
        InputError
            The folder holds something else.
        PartialError
            It cannot be written.
        """
        existing = path / RECORD_NAME
        if check_folder(path, lambda folder: (folder / RECORD_NAME).exists(), "published data set"):
            old = read_json(existing, ELSEWHERE)
            if [old.get(key) for key in ("format", "version")] != [_FORMAT, _VERSION]:
                raise InputError("is not a record of this version", where=existing, hint=ELSEWHERE)
            check_document(_Record, old, existing, ELSEWHERE)
            if not overwrite and old["hash"] != data_sha256(depends):
                raise other_configuration(path, "a published data set", old["depends"], depends)
            for folder in {path, *((path / name).parent for name in old["listed"])}:
                if folder.is_dir():
                    remove_unfinished(folder, {RECORD_NAME, *(Path(name).name for name in old["listed"])})
            if not overwrite:
                return cls(path, old)
            # The record last, which keeps the claim.
            for name in (*old["listed"], RECORD_NAME):
                remove_file(path / name)
        make_folder(path)
        record = {"hash": data_sha256(depends), "depends": dict(depends), "listed": sorted(listed)}
        claimed = cls(path, {"format": _FORMAT, "version": _VERSION, **record, "files": {}})
        # The record first: it claims the folder, even if the run is killed right after.
        write_json(existing, claimed.record)
        return claimed

    def add(self, name: str, write: Callable[[Path], Stored]) -> Stored:
        """Write a file with ``write(path)``, atomically, unless it is finished; its size and digest."""
        entry, path = self.record["files"].get(name), self.path / name
        if entry is None or not path.is_file() or path.stat().st_size != entry["bytes"]:
            make_folder(path.parent)
            stored = write(path)
            entry = self.record["files"][name] = {"bytes": stored.bytes, "sha256": stored.sha256}
            write_json(self.path / RECORD_NAME, self.record)
        return Stored(entry["bytes"], entry["sha256"])
