"""Order in which a shard and its sidecar are written."""

from __future__ import annotations

from pathlib import Path

from mbtf_core.data.folder import DataFolder, sidecar_name
from mbtf_core.files.atomic import Stored, write_text

SHARD = "train-00000.npz"


def test_an_old_sidecar_goes_before_its_shard_is_rewritten(tmp_path: Path) -> None:
    """Otherwise a run that is killed between the two leaves a shard that counts as finished."""
    folder, there = DataFolder.open(tmp_path), tmp_path / sidecar_name(SHARD)
    seen: list[bool] = []

    def write(path: Path) -> Stored:
        seen.append(there.exists())
        write_text(path, "content")
        return Stored(7, "0" * 64)

    for _ in range(2):
        folder.write_shard(SHARD, write, lambda stored: {"bytes": stored.bytes})
        assert there.exists()
    assert seen == [False, False]
