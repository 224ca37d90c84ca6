"""A triangle mesh as a material."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.digest import data_sha256, file_sha256
from mbtf_gen.tile.heightfield_tile import Material
from mbtf_gen.tile.mesh_file import MeshFile, read_mesh
from mbtf_gen.tile.mesh_tile import MeshTile


def mesh_material(spec: MeshFile, folder: Path) -> Material:
    """The material of a mesh.

    Parameters
    ----------
    spec : MeshFile
        What to read.
    folder : Path
        Folder that its file name is relative to.

    Returns
    -------
    Material

    Raises
    ------
    InputError
        The file cannot be read, or its triangles are no tile.
    """
    path = folder / spec.mesh
    tile = read_mesh(spec, folder)
    _, seam = tile.open_edges()
    what = f"{seam} edges at the border have no partner on the opposite side"
    warnings = (f"{path}: {what}: the tile may have a seam; check 'period'",) if seam else ()
    return Material(
        height=np.zeros((1, 1)),
        height_scale=1.0,
        height_bits=None,
        base_color=np.mean(
            [np.asarray(p.base_color).reshape(-1, 3).mean(axis=0) for p in tile.parts], axis=0
        ),
        bsdf={"type": "mbtf_surface"},
        shape=tile,
        files={"mesh": path},
        digests={
            "mesh": file_sha256(path),
            "settings": data_sha256(spec.model_dump(mode="json", exclude={"mesh"})),
        },
        warnings=warnings,
        notes=(
            f"mesh: {len(tile.faces):,} triangles in {len(tile.parts)} parts of {path.name}, "
            f"{tile.thickness:.3g} tile widths thick",
        ),
        resolution=spec.resolution,
    )


def inspect_mesh(material: Material, finest: int | None = None) -> dict[str, Any]:
    """What :func:`mesh_text` prints, for levels up to `finest`."""
    tile = material.shape
    assert isinstance(tile, MeshTile)
    edges, seam = tile.open_edges()
    return {
        "resolution": material.lattice(finest).shape()[1],
        "aspect": tile.aspect,
        "triangles": len(tile.faces),
        "thickness": tile.thickness,
        "open_edges": edges,
        "open_edges_at_the_border": seam,
        "parts": [
            {
                "name": part.name,
                "triangles": int(np.count_nonzero(tile.part == number)),
                "base_color": np.asarray(part.base_color).reshape(-1, 3).mean(axis=0).tolist(),
                "roughness": None if part.roughness is None else float(np.mean(part.roughness)),
                "metallic": None if part.metallic is None else float(np.mean(part.metallic)),
            }
            for number, part in enumerate(tile.parts)
        ],
        "warnings": list(material.warnings),
        "notes": list(material.notes),
    }


def mesh_text(found: dict[str, Any], name: str) -> str:
    """The data of :func:`inspect_mesh` as text for people."""
    edges = found["open_edges"]
    closed = f"{edges} open edges" if edges else "closed: every edge has two triangles"
    lines = [
        f"{name}: tile 1 x {found['aspect']:.4g}, triangles, resolution {found['resolution']}",
        "",
        f"mesh     {found['triangles']:,} triangles, {found['thickness']:.3g} tile widths thick; {closed}",
    ]
    for part in found["parts"]:
        color = " ".join(f"{c:.2f}" for c in part["base_color"])
        gloss = "Lambert" if part["roughness"] is None else f"mean roughness {part['roughness']:.2f}"
        metal = f", metallic {part['metallic']:.2f}" if part["metallic"] else ""
        lines.append(
            f"part     {part['name']}: {part['triangles']:,} triangles, mean color {color}, {gloss}{metal}"
        )
    return "\n".join([*lines, *(f"warning  {text}" for text in found["warnings"])])
