"""The material that a process loaded last: a command needs it several times."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.digest import file_sha256
from mbtf_core.shard_schema import Tiling
from mbtf_gen.tile.heightfield_tile import MAPS, Material
from mbtf_gen.tile.loading import described, material_of

# Bytes of the maps up to which a material is kept: a training process has no use for larger ones.
_KEPT_BYTES = 1 << 28
_kept: tuple[Any, Material] | None = None


def latest_material(path: str | Path, tile: Tiling | None = None) -> Material:
    """:func:`~mbtf_gen.tile.loading.load_material`; maps are not decoded again while the contents of
    folder and files are the same.

    Parameters
    ----------
    path, tile : as for ``load_material``

    Returns
    -------
    Material
        Not to be changed: the next call may return it again.

    Raises
    ------
    InputError
        As ``load_material``.
    """
    global _kept
    spec, folder, found = described(Path(path))
    method = spec.tiling(tile)
    # Loading adds notes to `found`.
    asked = (spec, folder, replace(found, notes=[*found.notes]), method)
    if _kept is not None and _kept[0] == asked and _unchanged(_kept[1]):
        return _kept[1]
    material = material_of(spec, folder, found, method)
    size = sum(np.asarray(getattr(material, name)).nbytes for name in MAPS)
    _kept = (asked, material) if size <= _KEPT_BYTES else None
    return material


def _unchanged(material: Material) -> bool:
    """Whether its files have the contents that it was loaded from."""
    try:
        return all(file_sha256(path) == material.digests[role] for role, path in material.files.items())
    except OSError:
        return False
