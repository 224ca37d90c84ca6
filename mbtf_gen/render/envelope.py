"""What fibers and meshes show from above: heights, slopes, coverage, reflectance, directions of fibers.

Vertical rays are traced to the tile, one per vertex of a grid. Where a ray passes through, the height is
that of the lowest point.
"""

from __future__ import annotations

from collections.abc import Collection

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.geometry import CLEARCOAT, FINEST_LEVEL, GLOSSY, Geometry
from mbtf_core.data.lattice import Lattice
from mbtf_core.images.resample import resample
from mbtf_gen.engine.types import Float, SurfaceInteraction3f
from mbtf_gen.render.bsdf.surface import Surface
from mbtf_gen.render.scene import TileScene, build_scene
from mbtf_gen.tile.fiber_tile import FiberTile
from mbtf_gen.tile.protocol import Tile

# Level of the grid of heights: so many above the finest of the data, up to a level and as many rays as fit
# into memory, at least that of maps.
_FINER, _USUAL, _RAYS = 3, 10, 1 << 22
# Largest slope that counts: those of a tube's sides grow without bound.
_STEEPEST = 3.0

F64 = NDArray[np.float64]


def seen_from_above(tile: Tile, finest: int, on: Collection[str]) -> Geometry:
    """Geometry of a tile that is no height field.

    Parameters
    ----------
    tile : fibers or a mesh
    finest : finest level of the data
    on : names of the effects that are simulated
    """
    level = min(finest + 1, FINEST_LEVEL)
    fine = max(level, min(finest + _FINER, _USUAL))
    while fine > level and Lattice(fine, tile.aspect).texels() > _RAYS:
        fine -= 1
    grid = Lattice(fine, tile.aspect).shape()
    scene = build_scene(tile, tile.surface(on))
    si = _vertical_hits(scene, grid)
    covered = _image(si.is_valid(), grid)
    heights = np.where(covered > 0.0, _image(si.p.z, grid) / scene.unit, -tile.thickness)
    nx, ny, nz = (_image(n, grid) for n in si.n)
    # Normals of tubes point down by rounding.
    steep = np.maximum(np.maximum(nz, np.hypot(nx, ny) / _STEEPEST), 1e-3)
    x, y = -nx / steep, -ny / steep

    def means(*channels: F64) -> NDArray[np.float32]:
        """Means over texels of some channels (H, W), which are 0 in gaps."""
        seen = np.stack([np.where(covered > 0.0, channel, 0.0) for channel in channels], -1)
        return np.asarray(resample(seen, *Lattice(level, tile.aspect).shape()), np.float32)

    coverage = means(covered)

    def of_matter(*channels: F64) -> NDArray[np.float32]:
        """Means over what is there; gaps have the mean of the tile."""
        seen = means(*channels)
        out = np.where(coverage > 0.0, seen / np.maximum(coverage, 1e-6), seen.mean((0, 1)) / coverage.mean())
        return (out if len(channels) > 1 else out[..., 0]).clip(0.0, 1.0)

    fibers = {}
    if isinstance(tile, FiberTile):
        yarn = np.clip((_image(si.uv.x, grid) * len(tile.colors)).astype(int), 0, len(tile.colors) - 1)
        tx, ty, tz = (_image(t, grid) for t in si.sh_frame.t)
        # One scattering may be that of all yarns.
        variances = np.array([s.longitudinal_variance for s in tile.scattering])
        variance = variances[np.minimum(yarn, len(variances) - 1)]
        products = (tx * tx, tx * ty, tx * tz, ty * ty, ty * tz, tz * tz)
        fibers = {"tangent_moments": means(*products), "longitudinal_variance": means(variance)[..., 0]}
        reflectance = {"base_color": list(np.moveaxis(tile.colors[yarn], -1, 0))}
    else:
        reflectance = _reflectance(scene, si, grid)
    return Geometry(
        np.minimum(heights - heights.max(), 0.0).astype(np.float32),
        tile.aspect,
        means(x, y),
        means(x * x, x * y, y * y),
        opacity=None if covered.all() else coverage[..., 0].clip(0.0, 1.0),
        **{name: of_matter(*channels) for name, channels in reflectance.items()},
        **fibers,
    )


class _Half:
    """In place of random numbers: rays pass where the opacity is at most one half."""

    def chance(self) -> Float:
        return mi.Float(0.5)


def _vertical_hits(scene: TileScene, shape: tuple[int, int]) -> SurfaceInteraction3f:
    """What rays from above meet at the centers of (rows, columns) texels, row 0 at the side ``v → 1``."""
    rows, columns = shape
    x = ((np.arange(columns) + 0.5) / columns - 0.5) * scene.unit
    y = (0.5 - (np.arange(rows) + 0.5) / rows) * scene.aspect * scene.unit
    at = (a.astype(np.float32).ravel() for a in np.meshgrid(x, y))
    start = mi.Point3f(*at, np.full(rows * columns, scene.unit, np.float32))
    ray = mi.Ray3f(start, mi.Vector3f(0.0, 0.0, -1.0))
    holes = {"holes": scene.surface, "rng": _Half()} if scene.surface.parts.opacity else {}
    si, *_ = scene.geometry.closest_hit(ray, mi.Mask(np.ones(rows * columns, bool)), 1, **holes)
    return si


def _image(values: Float, shape: tuple[int, int]) -> F64:
    """One number per ray as an image."""
    return np.broadcast_to(np.array(values, np.float64), shape[0] * shape[1]).reshape(shape)


def _reflectance(scene: TileScene, si: SurfaceInteraction3f, shape: tuple[int, int]) -> dict[str, list[F64]]:
    """Channels of the reflectance at hits, of the layers that some part of the mesh has."""
    parts: list[Surface] = list(scene.surface.surfaces)
    terms = [part.parts for part in parts]
    names = [*(GLOSSY if any(t.specular or t.metallic for t in terms) else ())]
    names += CLEARCOAT if any(t.clearcoat for t in terms) else ()

    def chosen(name: str) -> list[F64]:
        color = name == "base_color"
        out = mi.Color3f(0.0) if color else mi.Float(0.0)
        for number, part in enumerate(parts):
            texture = part.textures.get(name)
            if texture is not None:
                value = texture.eval(si) if color else texture.eval_1(si)
                out = dr.select(si.prim_index == number, value, out)
        return [_image(x, shape).clip(0.0, 1.0) for x in (out if color else [out])]

    return {name: chosen(name) for name in ("base_color", *names)}
