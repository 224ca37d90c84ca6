"""Cloth as a material."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.digest import data_sha256, file_sha256
from mbtf_gen.tile.cloth import fiber_tile, loose_ends
from mbtf_gen.tile.fiber_inspection import inspect_fibers
from mbtf_gen.tile.fiber_tile import FiberTile
from mbtf_gen.tile.fibers.cloth_file import ClothFile
from mbtf_gen.tile.fibers.yarn_sets import YARNS
from mbtf_gen.tile.heightfield_tile import Material


def inspect_cloth(material: Material, finest: int | None = None) -> dict[str, Any]:
    """What :func:`~mbtf_gen.tile.fiber_inspection.fiber_text` prints of a cloth, up to level `finest`."""
    assert isinstance(material.shape, FiberTile)
    return {
        "resolution": material.lattice(finest).shape()[1],
        **inspect_fibers(material.shape),
        "warnings": list(material.warnings),
        "notes": list(material.notes),
    }


def cloth_material(spec: ClothFile, folder: Path) -> Material:
    """The material of a cloth.

    Parameters
    ----------
    spec : ClothFile
        What to make.
    folder : Path
        Folder that its file names are relative to.

    Returns
    -------
    Material

    Raises
    ------
    InputError
        A file cannot be read, or its curves do not tile.
    """
    fibers = fiber_tile(spec, folder)
    files = {key: folder / name for key in ("pattern", "curves") if (name := getattr(spec, key)) is not None}
    digests = {role: file_sha256(path) for role, path in files.items()}
    # What the defaults stand for changes the data as well.
    settings = spec.model_dump(mode="json", exclude={"pattern", "curves"})
    settings["scattering"] = asdict(fibers.scattering)
    settings["yarns"] = [asdict(YARNS[entry.type]) for entry in (spec.yarn, spec.weft) if entry is not None]
    digests["settings"] = data_sha256(settings)
    kind = next(key for key in ("weave", "knit", "pattern", "curves") if getattr(spec, key) is not None)
    named = f" of {files[kind].name}" if kind in files else ""
    note = (
        f"fibers: {len(fibers.curves):,} with {fibers.segments:,} segments ({kind}{named}), "
        f"{fibers.thickness:.3g} tile widths thick"
    )
    warnings: tuple[str, ...] = ()
    if kind == "curves" and (loose := loose_ends(fibers)):
        what = f"{loose} ends at the border have no partner on the opposite side"
        warnings = (f"{files[kind]}: {what}: the tile has a seam; check 'period'",)
    return Material(
        height=np.zeros((1, 1)),
        height_scale=1.0,
        height_bits=None,
        base_color=fibers.colors.mean(axis=0),
        bsdf={"type": "hair"},
        shape=fibers,
        files=files,
        digests=digests,
        warnings=warnings,
        notes=(note,),
        resolution=spec.resolution,
    )
