"""Surfaces whose parameters differ from lane to lane, asked directly: no scene, no rays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_gen.render.bsdf.surface import Surface, SurfaceParts, SurfacePoint
from support.scenes import mi

ALL = SurfaceParts(diffuse=True, specular=True, metallic=True, clearcoat=True, sheen=True)


class LaneTexture:
    """A texture with one value per lane: a number, or a color (3, n)."""

    def __init__(self, value: ArrayLike) -> None:
        self.value = np.asarray(value, np.float32)

    def eval_1(self, si: Any) -> Any:
        """Number of each lane."""
        return mi.Float(self.value)

    def eval_3(self, si: Any) -> Any:
        """Three numbers of each lane."""
        return mi.Color3f(*(mi.Float(v) for v in self.value))

    def eval(self, si: Any) -> Any:
        """Color of each lane."""
        return mi.Color3f(mi.Float(self.value)) if self.value.ndim < 2 else self.eval_3(si)


def vectors(v: NDArray[np.floating[Any]]) -> Any:
    """``mi.Vector3f`` of an (n, 3) array."""
    return mi.Vector3f(np.ascontiguousarray(np.atleast_2d(v).T, np.float32))


def towards(cosine: ArrayLike, azimuth: ArrayLike = 0.0) -> NDArray[np.float64]:
    """Directions (n, 3) of given cosines and azimuths in degrees."""
    c, phi = np.broadcast_arrays(np.asarray(cosine, np.float64), np.radians(azimuth))
    s = np.sqrt((1.0 - c) * (1.0 + c))
    return np.stack([s * np.cos(phi), s * np.sin(phi), c], axis=-1)


def point(parts: SurfaceParts, wi: NDArray[np.float64], **maps: ArrayLike) -> SurfacePoint:
    """A surface on the plane z = 0 seen from directions `wi` (n, 3), one per lane.

    Maps not given: base color 1, specular 1/2, metallic 0, coat 1, white sheen of weight 1, all roughnesses
    0.3.
    """
    import drjit as dr

    given: dict[str, ArrayLike] = {
        "base_color": 1.0,
        "specular": 0.5,
        "metallic": 0.0,
        "clearcoat": 1.0,
        "roughness": 0.3,
        "clearcoat_roughness": 0.3,
        "sheen": 1.0,
        "sheen_color": 1.0,
        "sheen_roughness": 0.3,
        "slopes": np.zeros((3, 1)),
        **maps,
    }
    surface = Surface(parts, {name: LaneTexture(v) for name, v in given.items()})
    si = dr.zeros(mi.SurfaceInteraction3f, len(np.atleast_2d(wi)))
    si.n = mi.Normal3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(si.n)
    return surface.at(si, vectors(wi))


def sobol(count: int, dimensions: int, seed: int = 1) -> NDArray[np.float32]:
    """Scrambled Sobol points (count, dimensions) below 1."""
    from scipy.stats import qmc

    points = qmc.Sobol(dimensions, seed=seed).random(count)
    return np.minimum(points, 1 - 2**-24).astype(np.float32)
