"""Shards that an earlier run rendered but could not upload to its object store."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from mbtf_core.data.data_folder import abandoned, send_shard, waiting_shards
from mbtf_core.data.schema import ShardEntry
from mbtf_core.data.sidecar import finished_record, sidecar_of
from mbtf_core.errors import InputError, unwritable
from mbtf_core.files.atomic import read_checksummed, remove_file
from mbtf_core.files.digest import file_sha256


def recover_shards(folder: Path, entries: Sequence[ShardEntry], config_hash: str, plan: str) -> list[str]:
    """Upload the whole shards that ended processes of this machine left, or an earlier run of this process,
    instead of rendering them again.

    Parameters
    ----------
    folder : of the data set; nothing happens unless it is in a store
    entries : all shards of the data set; those that the store lacks are uploaded
    config_hash, plan : digests of the configuration and of the run plan that the shards must have

    Returns
    -------
    list of str
        Files that were uploaded.

    Raises
    ------
    PartialError : the store cannot be reached; the shards are kept
    """
    sent: list[str] = []
    known = {entry.file: entry for entry in entries}
    for path in waiting_shards(folder):
        if path.name in known and _is_whole(path, known[path.name], config_hash, plan):
            send_shard(path, sidecar_of(path))
            sent.append(path.name)
    with abandoned(folder) as folders:
        for left in folders:
            for entry in entries:
                source, path = left / entry.file, folder / entry.file
                if not _is_whole(source, entry, config_hash, plan):
                    continue
                if finished_record(folder, entry, config_hash) is not None:
                    continue
                # The store may have another one, of a shard that is lost.
                remove_file(sidecar_of(path))
                # Links, so that a failure leaves the shard where the next run finds it.
                _link(source, path)
                _link(sidecar_of(source), sidecar_of(path))
                send_shard(path, sidecar_of(path))
                sent.append(entry.file)
    return sent


def _link(source: Path, path: Path) -> None:
    """Give a file a second name in the working folder of a store; a copy where the disk has no links."""
    there = Path(os.fspath(path))
    try:
        there.unlink(missing_ok=True)
        try:
            os.link(source, there)
        except OSError:
            shutil.copyfile(source, there)
    except OSError as error:
        raise unwritable(path, error) from None


def _is_whole(shard: Path, entry: ShardEntry, config_hash: str, plan: str) -> bool:
    try:
        record = read_checksummed(sidecar_of(shard))
        expected = (config_hash, plan, entry.file, entry.rows)
        found = tuple(record.get(key) for key in ("config_hash", "plan", "file", "rows"))
        return found == expected and file_sha256(shard) == record.get("sha256")
    except (InputError, OSError):
        return False
