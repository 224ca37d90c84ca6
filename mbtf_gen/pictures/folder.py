"""A folder of pictures that a command writes, resumes, and replaces.

Beside the pictures lie ``config.yaml``, the resolved options, and ``pictures.json``, the record: it lists the
files that the command writes, and the finished ones with their sizes. Files that the record does not list
belong to others and are never touched.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from mbtf_core.config.settings import check_document
from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.data.schema import CONFIG_NAME
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import read_json, write_json, write_text
from mbtf_core.files.digest import data_sha256
from mbtf_core.files.folders import (
    ELSEWHERE,
    check_folder,
    make_folder,
    other_configuration,
    remove_unfinished,
)
from mbtf_core.pictures.reference import RECORD_NAME

FORMAT_NAME = "mbtf-pictures"
_VERSION = 2
# What does not change the content of pictures: the name of the material, and how values are displayed.
_DISPLAY = ("material", "exposure")


class _Picture(BaseModel):
    files: dict[str, int]
    facts: dict[str, Any]


class _Record(BaseModel):
    """Content of ``pictures.json``."""

    hash: str
    depends: dict[str, Any]
    files: list[str]
    pictures: dict[str, _Picture]


@dataclass
class PictureFolder:
    """A folder of pictures that was claimed by :meth:`claim`.

    Attributes
    ----------
    path : the folder
    record : content of its ``pictures.json``
    """

    path: Path
    record: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def claim(
        cls,
        path: Path,
        kind: str,
        *,
        files: Iterable[str],
        config: Mapping[str, Any],
        inputs: Mapping[str, str],
        overwrite: bool = False,
        command: str = "",
    ) -> PictureFolder:
        """Claim a folder that is empty, of the same configuration, or to be replaced; the caller owns it.

        Parameters
        ----------
        kind : kind of the pictures, as stored in the record
        files : names of all files that may be written
        config : resolved options, written beside the pictures; ``material`` and ``exposure`` do not
            determine their content, the others do
        inputs : digests of the input files by role, which determine it as well
        overwrite : remove what the folder's record lists, and start anew
        command : command that draws these pictures, for messages; ``mbtf-gen`` and the kind by default

        Raises
        ------
        InputError : the folder holds something else
        """
        command = command or f"mbtf-gen {kind}"
        depends = {**{k: v for k, v in config.items() if k not in _DISPLAY}, "inputs": dict(inputs)}
        existing = path / RECORD_NAME
        if check_folder(path, lambda folder: (folder / RECORD_NAME).exists(), f"pictures of {command}"):
            old = read_json(existing)
            if [old.get(key) for key in ("format", "version", "kind")] != [FORMAT_NAME, _VERSION, kind]:
                raise InputError(
                    f"holds pictures of something else than {command}, or of another version",
                    where=path,
                    hint=ELSEWHERE,
                )
            check_document(_Record, old, existing, ELSEWHERE)
            if not overwrite and old["hash"] != data_sha256(depends):
                raise other_configuration(path, "pictures", old["depends"], depends)
            # Unfinished files of a killed run.
            remove_unfinished(path, (CONFIG_NAME, RECORD_NAME, *old["files"]))
            if not overwrite:
                config_file, text = path / CONFIG_NAME, dump_yaml(config)
                if not config_file.exists() or config_file.read_text(encoding="utf-8") != text:
                    write_text(config_file, text)
                return cls(path, old)
            # What the record lists and nothing else; the record last, which keeps the claim.
            for name in (*old["files"], CONFIG_NAME, RECORD_NAME):
                (path / Path(name).name).unlink(missing_ok=True)
        make_folder(path)
        record = {
            "format": FORMAT_NAME,
            "version": _VERSION,
            "kind": kind,
            "hash": data_sha256(depends),
            "depends": depends,
            "files": sorted(files),
            "pictures": {},
        }
        folder = cls(path, record)
        # The record first: it claims the folder, even if the run is killed right after.
        folder._save()
        write_text(path / CONFIG_NAME, dump_yaml(config))
        return folder

    def _save(self) -> None:
        write_json(self.path / RECORD_NAME, self.record)

    def finished(self, name: str) -> dict[str, Any] | None:
        """Facts stored by :meth:`keep`, if all files of the picture exist with their full size."""
        entry = self.record["pictures"].get(name)
        if entry is None:
            return None
        for file, size in entry["files"].items():
            path = self.path / file
            if not path.is_file() or path.stat().st_size != size:
                return None
        facts: dict[str, Any] = entry["facts"]
        return facts

    def keep(self, name: str, files: Iterable[Path], facts: Mapping[str, Any]) -> None:
        """Record a picture as finished: its files, which lie in the folder, and plain data about it."""
        sizes = {path.name: path.stat().st_size for path in files}
        self.record["pictures"][name] = {"files": sizes, "facts": dict(facts)}
        self._save()
