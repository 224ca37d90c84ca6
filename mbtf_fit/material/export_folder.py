"""The folder of an exported material: the claim of one source on it."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel

from mbtf_core.atomic import read_json, write_json
from mbtf_core.config_file import check_document, check_schema
from mbtf_core.digest import file_sha256
from mbtf_core.errors import InputError
from mbtf_core.folders import ELSEWHERE, check_folder, other_configuration, remove_unfinished
from mbtf_fit.material.export import LAYERS_NAME, TEXTURES_NAME
from mbtf_fit.material.format import DESCRIPTION_NAME, WEIGHTS_NAME
from mbtf_fit.material.material import Material
from mbtf_fit.material.transmittance import TRANSMITTANCE_NAME

EXPORT_NAME = "export.json"
_FORMAT = "mbtf-export"
_SCHEMA = 1
_FILES = (EXPORT_NAME, DESCRIPTION_NAME, WEIGHTS_NAME, TRANSMITTANCE_NAME, LAYERS_NAME, TEXTURES_NAME)


class _Source(BaseModel):
    """What determines an exported material: the digest of its source's description, and its precision."""

    material: str
    half: bool


class _Record(BaseModel):
    """Content of ``export.json``."""

    source: _Source


def claim_export(folder: Path, material: Path, *, half: bool, overwrite: bool) -> bool:
    """Claim a folder for the export of a material; the caller owns it.

    Parameters
    ----------
    folder : Path
    material : the exported material's folder
    half : 16-bit floats are stored
    overwrite : replace the export of another material

    Returns
    -------
    bool
        Whether the folder holds this export already, complete.

    Raises
    ------
    InputError : the folder holds something else
    """
    source = _Source(material=file_sha256(material / DESCRIPTION_NAME), half=half)
    path = folder / EXPORT_NAME
    if check_folder(folder, lambda place: (place / EXPORT_NAME).exists(), "export"):
        old = read_json(path)
        check_schema(old, _SCHEMA, path, ELSEWHERE)
        found = check_document(_Record, old, path, ELSEWHERE).source
        if found != source and not overwrite:
            raise other_configuration(folder, "an export", found.model_dump(), source.model_dump())
        remove_unfinished(folder, _FILES)
        if found == source and not overwrite:
            return _is_complete(folder)
        # The description goes first: without it nothing counts as a finished material.
        for name in (DESCRIPTION_NAME, *_FILES):
            (folder / name).unlink(missing_ok=True)
    # The record first: it claims the folder, even if the command is killed right after.
    write_json(path, {"format": _FORMAT, "schema": _SCHEMA, "source": source.model_dump()})
    return False


def _is_complete(folder: Path) -> bool:
    try:
        Material.load(folder)
    except InputError:
        return False
    return True
