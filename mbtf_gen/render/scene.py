"""The tile as a scene: its geometry and its BSDF, centered on the origin.

Scene units: the longer side of the tile is 32 units. There single precision resolves 2e-6 units, which
suffices for a ray offset of 8e-6 units.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mitsuba as mi

from mbtf_core.errors import InputError, reason
from mbtf_gen.config.generator import Tracer
from mbtf_gen.engine.types import BSDF
from mbtf_gen.render.bsdf.plugin import PartSurface, SurfaceBSDF, surface_of
from mbtf_gen.render.directional_light import SmoothedDirectional
from mbtf_gen.render.sensor import QuerySensor
from mbtf_gen.tile.fiber_tile import FiberTile
from mbtf_gen.tile.heights.grid import HeightGrid
from mbtf_gen.tile.mesh_tile import MeshTile
from mbtf_gen.tile.tracers.heightfield_tracer import HeightfieldGeometry
from mbtf_gen.tile.tracers.mesh_tracer import MeshGeometry
from mbtf_gen.tile.tracers.protocol import TileGeometry

LONG_SIDE = 32.0
# Rays start this far above the reference plane, in units: more than the rounding of the highest vertex.
CLEARANCE = 0.01


def register_plugins() -> None:
    """Register the plugins with Mitsuba's current variant: ``mbtf_queries`` (sensor), ``mbtf_directional``
    (emitter), ``mbtf_surface`` (BSDF)."""
    mi.register_sensor("mbtf_queries", lambda props: QuerySensor(props))
    mi.register_bsdf("mbtf_surface", lambda props: SurfaceBSDF(props))
    mi.register_emitter("mbtf_directional", lambda props: SmoothedDirectional(props))


@dataclass(frozen=True)
class Tile:
    """A periodic tile as a scene.

    Attributes
    ----------
    aspect : float
        H/W of the tile.
    unit : float
        Scene units per tile width.
    geometry : TileGeometry
        Geometry in scene units.
    surface : Surface or MitsubaSurface
        Reflection, see :mod:`mbtf_gen.render.bsdf.surface`.
    """

    aspect: float
    unit: float
    geometry: TileGeometry
    surface: Any


def unit_of(aspect: float) -> float:
    """Scene units per tile width."""
    return LONG_SIDE / max(1.0, aspect)


def build_tile(
    shape: HeightGrid | FiberTile | MeshTile,
    bsdf: Mapping[str, Any] | BSDF | Sequence[Mapping[str, Any]],
    tracer: Tracer = "heightfield",
) -> Tile:
    """Build the scene of a tile.

    Parameters
    ----------
    shape : HeightGrid, FiberTile or MeshTile
        Heights, fibers or triangles, in tile widths.
    bsdf : mapping, mitsuba.BSDF or sequence of mapping
        A Mitsuba dictionary, or a loaded BSDF; one dictionary per part of a mesh.
    tracer : str
        Of heights. ``heightfield``: rays follow the grid's cells. ``mesh``: Mitsuba traces the grid's
        triangles.

    Raises
    ------
    InputError
        Mitsuba rejects the BSDF.
    """
    register_plugins()
    unit = unit_of(shape.aspect)
    if isinstance(shape, MeshTile) and isinstance(bsdf, Sequence):
        parts = PartSurface([mi.load_dict(dict(part)).surface for part in bsdf])
        return Tile(shape.aspect, unit, shape.trace(unit), parts)
    if isinstance(bsdf, Mapping):
        try:
            bsdf = mi.load_dict(dict(bsdf))
        except Exception as error:  # whatever the plugins raise about their parameters
            text = re.sub(r"\[\w+\.cpp:\d+\]\s*", "", reason(error, 250))
            raise InputError(f"Mitsuba rejects the BSDF '{bsdf.get('type')}' ({text})") from None
    surface = surface_of(bsdf)
    geometry: TileGeometry
    if isinstance(shape, FiberTile | MeshTile):
        geometry = shape.trace(unit)
    elif tracer == "mesh":
        geometry = MeshGeometry.of_grid(shape, unit)
    else:
        geometry = HeightfieldGeometry.of(shape, unit, surface.transmits)
    return Tile(shape.aspect, unit, geometry, surface)
