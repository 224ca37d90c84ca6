"""A tile of triangles, as it is traced."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.meshes.content import Value, numbers_of
from mbtf_gen.config.generator import GeometrySection
from mbtf_gen.tile.maps.material_file import LOBES, REFLECTING, ROLES
from mbtf_gen.tile.protocol import REFLECTION, Tile, layer_weight
from mbtf_gen.tile.reflectance import in_use, lobe_widths, plugin_dictionary
from mbtf_gen.tile.tracers.protocol import TileGeometry

F64 = NDArray[np.float64]
# Distance in tile widths within which vertices count as one.
_SAME = 1e-5
# Side of the cells that hold one vertex each in this comparison.
_CELL = _SAME / 4


@dataclass(frozen=True)
class MeshPart:
    """Reflectance of the triangles of one material.

    Attributes
    ----------
    name : its name in the file
    maps : numbers, colors and textures by role (:data:`~mbtf_gen.tile.maps.material_file.ROLES`),
        ``base_color`` among them, and ``opacity_cutoff``. Textures have the same wrap mode along both axes.
    """

    name: str
    maps: Mapping[str, Value]


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
        # One vertex of each cell: the pairs of many at one place would be as many as its square.
        i, j, k = np.moveaxis(np.floor((place - place.min(axis=0)) / _CELL).astype(np.int64), -1, 0)
        _, first, cell = np.unique(
            (i * (j.max() + 1) + j) * (k.max() + 1) + k, return_index=True, return_inverse=True
        )
        near = cKDTree(place[first], boxsize=[*size, 0.0]).query_pairs(_SAME, output_type="ndarray")
        links = coo_array((np.ones(len(near)), near.T), (len(first), len(first)))
        same = connected_components(links, directed=False)[1][cell]
        ends = np.stack([self.faces, np.roll(self.faces, -1, axis=1)], axis=-1).reshape(-1, 2)
        welded = np.sort(same[ends].astype(np.int64), axis=1) @ (len(self.vertices), 1)
        _, index, count = np.unique(welded, return_index=True, return_counts=True)
        alone = self.vertices[ends[index[count == 1]]][:, :, :2] / size
        on_border = (np.abs(alone - np.rint(alone)) < _SAME).all(axis=1).any(axis=1)
        return len(alone), int(on_border.sum())

    def surface(
        self, on: Collection[str] = REFLECTION, slopes: NDArray[np.float64] | None = None
    ) -> list[dict[str, Any]]:
        """Mitsuba dictionaries of the parts, holes included."""
        return [plugin_dictionary(in_use(part.maps, {*on, "opacity"})) for part in self.parts]

    @property
    def base_color(self) -> F64:
        """Smallest and largest color (2, parts, 3) of each part."""
        colors = [numbers_of(part.maps["base_color"]).reshape(-1, 3) for part in self.parts]
        return np.stack([[color.min(axis=0) for color in colors], [color.max(axis=0) for color in colors]])

    def weight(self, effect: str) -> float:
        return max(layer_weight(part.maps, effect) for part in self.parts)

    @property
    def bsdf_type(self) -> None:
        """None: there are maps."""

    @property
    def is_lambert(self) -> bool:
        return not any({*REFLECTING, *LOBES} & part.maps.keys() for part in self.parts)

    def narrowest_lobe(self) -> tuple[float, str]:
        widths = (width for part in self.parts for width in lobe_widths(part.maps))
        return min([2.0, *widths]), "narrowest lobe"

    @property
    def nbytes(self) -> int:
        values = [value for part in self.parts for value in part.maps.values()]
        textures = {id(v[0].pixels): v[0].pixels.nbytes for v in values if isinstance(v, tuple)}
        return self.vertices.nbytes + self.faces.nbytes + self.uv.nbytes + sum(textures.values())

    def properties(self) -> dict[str, Any]:
        return {"triangles": len(self.faces)}

    def inspect(self, options: GeometrySection, finest: int | None = None) -> dict[str, Any]:
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
                    **{role: _mean(part.maps[role]) for role in ROLES if role in part.maps},
                }
                for number, part in enumerate(self.parts)
            ],
            "warnings": list(self.warnings),
            "notes": list(self.notes),
        }


def _mean(value: Value) -> float | list[float]:
    """Mean number or color of a value."""
    numbers = numbers_of(value)
    mean = numbers if numbers.ndim < 2 else numbers.mean(axis=(0, 1))
    return mean.tolist() if mean.ndim else float(mean)
