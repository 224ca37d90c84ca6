"""A tile of triangles, as it is traced."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_gen.config.generator import GeometrySection
from mbtf_gen.tile.protocol import Tile
from mbtf_gen.tile.reflectance import reflectance
from mbtf_gen.tile.tracers.protocol import TileGeometry

F64 = NDArray[np.float64]
# Distance in tile widths within which vertices count as one.
_SAME = 1e-5


@dataclass(frozen=True)
class MeshPart:
    """Reflectance of the triangles of one material.

    Attributes
    ----------
    name : str
        Its name in the file.
    base_color : (h, w, 3) or (3,) float64 array
        Linear Rec.709 in [0, 1]. Row 0 of maps is the side ``v → 1``.
    roughness, metallic : (h, w) float64 array, float or None
        In [0, 1]; None for a Lambert surface.
    """

    name: str
    base_color: F64
    roughness: F64 | float | None = None
    metallic: F64 | float | None = None


@dataclass(frozen=True)
class MeshTile(Tile):
    """Triangles of one period, in tile widths.

    Attributes
    ----------
    aspect : float
        H/W of the tile.
    vertices : (n, 3) float64 array
        Positions; the highest touches the reference plane z = 0.
    faces : (m, 3) int array
        Vertices of each triangle.
    uv : (n, 2) float64 array
        Texture coordinates.
    part : (m,) int array
        Part of each triangle.
    parts : sequence of MeshPart
        Their reflectance.
    """

    kind = "mesh"

    aspect: float
    vertices: F64
    faces: NDArray[np.int_]
    uv: F64
    part: NDArray[np.int_]
    parts: Sequence[MeshPart]

    @cached_property
    def thickness(self) -> float:
        """Height of the triangles' slab, in tile widths."""
        # Not minus zero.
        return 0.0 - float(self.vertices[self.faces, 2].min())

    def copies(self) -> tuple[NDArray[np.int_], F64]:
        """(number, shift (k, 3)) of all triangles that reach into the box [0, 1] x [0, aspect], moved there
        by whole periods."""
        corners = self.vertices[self.faces, :2]
        size = np.array([1.0, self.aspect])
        least, most = corners.min(axis=1) - _SAME, corners.max(axis=1) + _SAME
        first, last = np.ceil(-most / size).astype(int), np.floor((size - least) / size).astype(int)
        faces, shifts = [], []
        for i in range(first[:, 0].min(), last[:, 0].max() + 1):
            for j in range(first[:, 1].min(), last[:, 1].max() + 1):
                k = np.array([i, j])
                inside = np.flatnonzero(((first <= k) & (k <= last)).all(axis=1))
                faces.append(inside)
                shifts.append(np.tile([*(k * size), 0.0], (len(inside), 1)))
        return np.concatenate(faces), np.concatenate(shifts)

    def trace(self, unit: float, below: bool = False) -> TileGeometry:
        """The triangles as rays meet them."""
        from mbtf_gen.tile.tracers.mesh_tracer import MeshTileGeometry

        number, shift = self.copies()
        faces = self.faces[number]
        corners = self.vertices[faces] + shift[:, None]
        return MeshTileGeometry.of_triangles(corners, self.uv[faces], self.part[number], self.aspect, unit)

    def open_edges(self) -> tuple[int, int]:
        """Numbers of edges that belong to one triangle alone, all of them and those on the border, where
        opposite sides of the period count as one."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components
        from scipy.spatial import cKDTree

        size = np.array([1.0, self.aspect])
        place = np.column_stack([self.vertices[:, :2] % size, self.vertices[:, 2]])
        place[:, :2] = np.where(place[:, :2] < size, place[:, :2], 0.0)
        near = cKDTree(place, boxsize=[*size, 0.0]).query_pairs(_SAME, output_type="ndarray")
        links = coo_array((np.ones(len(near)), near.T), (len(place), len(place)))
        _, same = connected_components(links, directed=False)
        ends = np.stack([self.faces, np.roll(self.faces, -1, axis=1)], axis=-1).reshape(-1, 2)
        welded = np.sort(same[ends], axis=1)
        _, index, count = np.unique(welded, axis=0, return_index=True, return_counts=True)
        alone = self.vertices[ends[index[count == 1]]][:, :, :2] / size
        on_border = (np.abs(alone - np.rint(alone)) < _SAME).all(axis=1).any(axis=1)
        return len(alone), int(on_border.sum())

    def surface(
        self, on: Collection[str] = (), slopes: NDArray[np.float64] | None = None
    ) -> list[dict[str, Any]]:
        """Mitsuba dictionaries of the parts."""
        return [reflectance(part.base_color, part.roughness, part.metallic) for part in self.parts]

    @property
    def base_color(self) -> F64:
        """Mean (3,) over the parts of their mean colors."""
        colors = [np.asarray(p.base_color).reshape(-1, 3).mean(axis=0) for p in self.parts]
        return np.asarray(np.mean(colors, axis=0))

    def properties(self) -> dict[str, Any]:
        """Number of triangles, for the manifest."""
        return {"triangles": len(self.faces)}

    def inspect(self, options: GeometrySection, finest: int | None = None) -> dict[str, Any]:
        """Statistics as plain data; lengths are in tile widths."""
        self.configured(options)
        edges, seam = self.open_edges()
        return {
            "resolution": self.lattice(finest).shape()[1],
            "aspect": self.aspect,
            "triangles": len(self.faces),
            "thickness": self.thickness,
            "open_edges": edges,
            "open_edges_at_the_border": seam,
            "parts": [
                {
                    "name": part.name,
                    "triangles": int(np.count_nonzero(self.part == number)),
                    "base_color": np.asarray(part.base_color).reshape(-1, 3).mean(axis=0).tolist(),
                    "roughness": None if part.roughness is None else float(np.mean(part.roughness)),
                    "metallic": None if part.metallic is None else float(np.mean(part.metallic)),
                }
                for number, part in enumerate(self.parts)
            ],
            "warnings": list(self.warnings),
            "notes": list(self.notes),
        }

    def describe(self, found: Mapping[str, Any], name: str) -> str:
        """The data of :meth:`inspect` as text for people."""
        edges = found["open_edges"]
        closed = f"{edges} open edges" if edges else "closed: every edge has two triangles"
        lines = [
            f"{name}: tile 1 x {found['aspect']:.4g}, triangles, resolution {found['resolution']}",
            "",
            f"mesh     {found['triangles']:,} triangles, {found['thickness']:.3g} tile widths thick; "
            f"{closed}",
        ]
        for part in found["parts"]:
            color = " ".join(f"{c:.2f}" for c in part["base_color"])
            gloss = "Lambert" if part["roughness"] is None else f"mean roughness {part['roughness']:.2f}"
            metal = f", metallic {part['metallic']:.2f}" if part["metallic"] else ""
            lines.append(
                f"part     {part['name']}: {part['triangles']:,} triangles, mean color {color}, "
                f"{gloss}{metal}"
            )
        return "\n".join([*lines, *(f"warning  {text}" for text in found["warnings"])])
