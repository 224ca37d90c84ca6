"""The shards as they are: linked or copied, with a manifest that names no folder of its author."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.data.schema import CONFIG_NAME, MANIFEST_NAME
from mbtf_core.files.atomic import Stored, checksummed, file_sha256, sync_folder, temporary_of, write_chunks

_CHUNK = 1 << 20


def public_config(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration in a manifest with the bare name of the material, without the folders above it."""
    config = dict(manifest["config"])
    if "material" in config:
        config["material"] = Path(config["material"]).name or "material"
    return config


def public_documents(manifest: Mapping[str, Any]) -> dict[str, bytes]:
    """Manifest and configuration of a published copy of the shards, by file name.

    The hash of the configuration does not cover the material's name, so that the sidecars stay valid.
    """
    config = public_config(manifest)
    text = dump_yaml(config)
    digest = hashlib.sha256(text.encode()).hexdigest()
    return {
        MANIFEST_NAME: checksummed({**manifest, "config": config, "config_yaml": digest}),
        CONFIG_NAME: text.encode(),
    }


def link_or_copy(source: Path, path: Path) -> Stored:
    """A hard link to a file, or a copy of it where the disk has none; atomically.

    Shards are replaced, never changed in place, so that a link keeps its content.

    Raises
    ------
    PartialError : the disk is full or the folder cannot be written
    """
    temporary = temporary_of(path)
    with contextlib.suppress(OSError):
        temporary.unlink(missing_ok=True)
        os.link(source, temporary)
        os.replace(temporary, path)
        sync_folder(path.parent)
        return Stored(path.stat().st_size, file_sha256(path))
    return copy_file(source, path)


def copy_file(source: Path, path: Path) -> Stored:
    """A copy of a file, atomically.

    Raises
    ------
    PartialError : the disk is full or the folder cannot be written
    """
    with source.open("rb") as stream:
        return write_chunks(path, iter(lambda: stream.read(_CHUNK), b""))
