"""The folder of an export: the claim of one command on it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, Field

from mbtf_core.config.settings import check_document, check_schema
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import read_json, remove_file, write_json
from mbtf_core.files.folders import ELSEWHERE, check_folder, other_configuration, remove_unfinished
from mbtf_fit.material.format import DESCRIPTION_NAME
from mbtf_fit.material.material import Material

EXPORT_NAME = "export.json"
_FORMAT = "mbtf-export"
_SCHEMA = 3


class ExportSource(BaseModel):
    """What determines an export.

    Attributes
    ----------
    material : SHA-256 of the description of the exported material
    to : formats, in alphabetical order
    half : whether weights and texels are rounded to 16 bits
    options : those of the formats that were given; of a file its SHA-256
    """

    material: str
    to: list[str]
    half: bool
    options: dict[str, Any] = {}


class _Record(BaseModel):
    """Content of ``export.json``."""

    source: ExportSource
    files: list[Annotated[str, Field(pattern=r"^\w[\w.-]*$")]]


class ExportClaim:
    """A claim on a folder, while an export is written.

    Attributes
    ----------
    is_complete : bool
        Whether the folder holds this export of a material already, complete.
    files : list of str
        Names of the files that were written; the caller adds them.
    """

    def __init__(self, is_complete: bool) -> None:
        self.is_complete = is_complete
        self.files: list[str] = []


@contextmanager
def claimed(
    folder: Path, source: ExportSource, names: Sequence[str], *, overwrite: bool
) -> Iterator[ExportClaim]:
    """Claim a folder for an export; the caller owns it.

    A folder that holds another export is refused, or emptied of it with `overwrite`.

    Parameters
    ----------
    folder : Path
    source : ExportSource
    names : names of the files that exports may have
    overwrite : replace another export

    Raises
    ------
    InputError : the folder holds something else
    """
    path = folder / EXPORT_NAME
    old = _read(folder)
    if old is not None and old.source != source and not overwrite:
        raise other_configuration(folder, "an export", old.source.model_dump(), source.model_dump())
    if old is not None:
        remove_unfinished(folder, (EXPORT_NAME, *names, *old.files))
    same = old is not None and old.source == source and not overwrite
    complete = same and _is_complete(folder)
    # A material is written anew if it is not complete; files of other formats are replaced one by one.
    if old is not None and not complete and not (same and "material" not in source.to):
        # The description goes first: without it nothing counts as a finished material.
        for name in dict.fromkeys((DESCRIPTION_NAME, *names, *old.files)):
            remove_file(folder / name)
    if not same:
        # The record first: it claims the folder, even if the command is killed right after.
        _write(path, source, [])
    claim = ExportClaim(complete)
    try:
        yield claim
    except Exception:
        if not any((folder / name).exists() for name in names):
            remove_file(path)
        raise
    if old is None or not same or set(old.files) != set(claim.files):
        _write(path, source, claim.files)


def _read(folder: Path) -> _Record | None:
    """The record of a folder; None where it is missing or empty."""
    if not check_folder(folder, lambda place: (place / EXPORT_NAME).exists(), "export"):
        return None
    path = folder / EXPORT_NAME
    data = read_json(path)
    check_schema(data, _SCHEMA, path, ELSEWHERE)
    return check_document(_Record, data, path, ELSEWHERE)


def _write(path: Path, source: ExportSource, files: Sequence[str]) -> None:
    record = _Record(source=source, files=sorted(files))
    write_json(path, {"format": _FORMAT, "schema": _SCHEMA, **record.model_dump()})


def _is_complete(folder: Path) -> bool:
    try:
        Material.load(folder)
    except InputError:
        return False
    return True
