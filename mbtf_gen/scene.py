"""The displaced tile as a Mitsuba scene: one mesh of one period plus an apron, centred on the origin.

Scene units: the longer side of the tile is 32 units, where single precision resolves 2e-6 and hit points are
exact enough for a ray offset of 1e-6 tile widths.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .bsdf import SurfaceBSDF, surface_of
from .emitter import SmoothedDirectional
from .errors import InputError, reason
from .heightfield import HeightGrid, grid_faces, grid_vertices
from .periodic import Period
from .sensor import QuerySensor
from .tracing import World

LONG_SIDE = 32.0
# Apron beyond the period, as a share of it: measured fastest between 0 and 1/2 on a 512² grid.
APRON_SHARE = 0.125
# Rays begin this far above the reference plane, in units; it must exceed the rounding of the highest vertex.
CLEARANCE = 0.01
# Ray offset over the largest coordinate: a few units in the last place of single precision.
RELATIVE_OFFSET = 2.0e-6


def register_plugins() -> None:
    """Make the project's plugins known to Mitsuba's loaders under the current variant: ``mbtf_queries``
    (sensor), ``mbtf_directional`` (emitter), ``mbtf_surface`` (BSDF)."""
    mi.register_sensor("mbtf_queries", lambda props: QuerySensor(props))
    mi.register_bsdf("mbtf_surface", lambda props: SurfaceBSDF(props))
    mi.register_emitter("mbtf_directional", lambda props: SmoothedDirectional(props))


@dataclass(frozen=True)
class Tile:
    """A displaced periodic tile, ready to be traced.

    Attributes
    ----------
    grid : its heights in tile widths
    unit : scene units per tile width
    mesh : Mitsuba mesh of a period and its apron
    world : what rays meet
    """

    grid: HeightGrid
    unit: float
    mesh: Any
    world: World

    @property
    def scene(self) -> Any:
        """Mitsuba scene that holds the mesh alone."""
        return self.world.scene

    @property
    def period(self) -> Period:
        """How rays repeat."""
        return self.world.period

    @property
    def aspect(self) -> float:
        """H/W of the tile."""
        return self.grid.aspect


def mesh_of_grid(grid: HeightGrid, unit: float, apron: tuple[int, int], bsdf: Any) -> Any:
    """Mitsuba mesh of one period plus `apron` = (rows, columns) cells on each side, in scene units."""
    vertices = grid_vertices(grid, apron)
    rows, columns = vertices.shape[:2]
    flat = vertices.reshape(-1, 3)
    faces = grid_faces(rows, columns)
    props = mi.Properties()
    props["bsdf"] = bsdf
    # Face normals: interpolated ones lose energy on coarse grids.
    props["face_normals"] = True
    mesh = mi.Mesh("tile", len(flat), len(faces), props=props, has_vertex_texcoords=True)
    centre = np.array([0.5, 0.5 * grid.aspect, 0.0])
    params = mi.traverse(mesh)
    params["vertex_positions"] = ((flat - centre) * unit).astype(np.float32).ravel()
    # Mitsuba's bitmaps have row 0 at v = 0, ours at v → 1: its texture coordinates are (u, 1-v).
    texcoords = np.column_stack([flat[:, 0], 1.0 - flat[:, 1] / grid.aspect])
    params["vertex_texcoords"] = texcoords.astype(np.float32).ravel()
    params["faces"] = faces.ravel()
    params.update()
    return mesh


def _load_bsdf(bsdf: Mapping[str, Any]) -> Any:
    try:
        return mi.load_dict(dict(bsdf))
    except Exception as error:  # whatever the plugins raise about their parameters
        text = re.sub(r"\[\w+\.cpp:\d+\]\s*", "", reason(error, 250))
        raise InputError(f"Mitsuba does not take the BSDF '{bsdf.get('type')}' ({text})") from None


def build_tile(grid: HeightGrid, bsdf: Mapping[str, Any] | Any, apron_share: float = APRON_SHARE) -> Tile:
    """Tile of a height grid and a BSDF (a Mitsuba dictionary or object).

    Raises
    ------
    InputError : Mitsuba does not take the BSDF
    """
    register_plugins()
    rows, columns = grid.z.shape
    unit = LONG_SIDE / max(1.0, grid.aspect)
    cells = (max(2, math.ceil(apron_share * rows)), max(2, math.ceil(apron_share * columns)))
    loaded = _load_bsdf(bsdf) if isinstance(bsdf, Mapping) else bsdf
    mesh = mesh_of_grid(grid, unit, cells, loaded)
    # Robust intersections: otherwise one ray in 10⁵ slips between two triangles.
    scene = mi.load_dict({"type": "scene", "embree_use_robust_intersections": True, "tile": mesh})
    cell = (unit / columns, unit * grid.aspect / rows)
    extent = max(0.5 * LONG_SIDE * (1.0 + 2.0 * apron_share), grid.relief * unit)

    def number(x: float) -> Any:
        return dr.opaque(mi.Float, x)

    period = Period(
        low=(number(0.5 * cell[0] - 0.5 * unit), number(-0.5 * cell[1] - 0.5 * unit * grid.aspect)),
        size=(number(unit), number(unit * grid.aspect)),
        reach=(number((cells[1] - 0.5) * cell[0]), number((cells[0] - 0.5) * cell[1])),
        bottom=number(-grid.relief * unit - CLEARANCE),
        top=number(CLEARANCE),
        overlap=number(0.25 * min(cell)),
        offset=number(RELATIVE_OFFSET * extent),
    )
    world = World(scene, period, surface_of(loaded), period.size)
    return Tile(grid, unit, mesh, world)
