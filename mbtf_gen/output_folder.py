"""The folder that a data set is written into: claimed, resumed, refused, or cleared."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .atomic import read_json, write_json, write_text
from .errors import InputError
from .schema import CONFIG_NAME, FORMAT_NAME, MANIFEST_NAME, SCHEMA_VERSION, SPLITS
from .settings import differences, dump_yaml, in_short

if TYPE_CHECKING:
    from .generation import Job

# What a run writes into its folder, and what a killed one leaves there.
_OWN = re.compile(
    rf"{re.escape(MANIFEST_NAME)}|{re.escape(CONFIG_NAME)}|(?:{'|'.join(SPLITS)})-\d+\.(?:npz|exr|json)"
)
_LEFTOVER = re.compile(rf"\.(?:{_OWN.pattern})\.\d+\.tmp|\.(?:{'|'.join(SPLITS)})-\d+\.lock")


def open_folder(job: Job, folder: Path, manifest: dict[str, Any], overwrite: bool) -> None:
    """Claim the output folder: new, empty, resumed, or replaced.

    Raises
    ------
    InputError : it holds something else
    """
    if folder.exists() and not folder.is_dir():
        raise InputError("is a file, not a folder", where=folder)
    existing = folder / MANIFEST_NAME
    if existing.exists():
        old = read_json(existing)
        if old.get("format") != FORMAT_NAME:
            raise InputError(
                f"is not a manifest of {FORMAT_NAME}", where=existing, cure="choose another folder with -o"
            )
        if overwrite:
            _clear(folder)
        elif old.get("config_hash") != job.config_hash:
            config = old.get("config")
            before = {**(config if isinstance(config, dict) else {}), "inputs": old.get("inputs", {})}
            before["schema"] = old.get("schema")
            after = {**manifest["config"], "inputs": manifest["inputs"], "schema": SCHEMA_VERSION}
            changes = in_short(differences(before, after)) or "inputs differ"
            raise InputError(
                f"holds a data set of another configuration: {changes}",
                where=folder,
                cure="choose another folder with -o, or replace it with --overwrite",
            )
    elif folder.exists() and not all(_LEFTOVER.fullmatch(p.name) for p in folder.iterdir()):
        if existing.exists():
            # Another writer of the same data set made it between the two looks.
            return open_folder(job, folder, manifest, overwrite)
        raise InputError(
            "is not empty and holds no data set", where=folder, cure="choose another folder with -o"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be made ({error.strerror})", where=folder) from None
    # The manifest first: it makes the folder ours, whatever instant the run is killed at.
    if not existing.exists():
        write_json(existing, manifest)
    if not (folder / CONFIG_NAME).exists():
        write_text(folder / CONFIG_NAME, dump_yaml(manifest["config"]))


def _clear(folder: Path) -> None:
    """Remove a data set and nothing else; the manifest last, so that the rest never stands without it."""
    names = (p.name for p in folder.iterdir())
    for name in sorted(names, key=lambda name: name == MANIFEST_NAME):
        if _OWN.fullmatch(name) or _LEFTOVER.fullmatch(name):
            (folder / name).unlink(missing_ok=True)
