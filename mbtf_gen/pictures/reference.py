"""Reference pictures: path-traced from the micro-geometry, with both halves.

A picture is stored as an EXR image with the channels of the shard schema (``u.x``, ``omega_o.z``,
``value_a.R``, …), so that a fitted material can be evaluated at its queries, and as a PNG for display.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.schema import Queries
from mbtf_core.pictures import PIXEL_SIGMA, Camera, PixelKind, ReferenceImage

if TYPE_CHECKING:
    from mbtf_gen.render.estimator import Estimator


def _camera_rays(camera: Camera, estimator: Estimator) -> Any:
    """Source of first rays whose n-th query is the camera's n-th pixel under its Gaussian filter."""
    import drjit as dr
    import mitsuba as mi

    from mbtf_gen.render.scene import CLEARANCE
    from mbtf_gen.render.sensor import ray_through

    tile = estimator.tile

    def numbers(*values: float) -> list[Any]:
        """Opaque, so that all cameras share the compiled kernel."""
        return [dr.opaque(mi.Float, float(v)) for v in values]

    forward, right, up = (mi.Vector3f(*numbers(*axis)) for axis in camera.frame())
    position = mi.Point3f(*numbers(*camera.position))
    unit, aspect, start, pitch = numbers(tile.unit, tile.aspect, CLEARANCE, camera.pixel_pitch)
    center_x, center_y = numbers(camera.columns / 2 - 0.5, camera.rows / 2 - 0.5)
    columns = dr.opaque(mi.UInt32, camera.columns)

    class CameraRays:
        def set_queries(self, queries: Queries, first: int = 0) -> None:
            self.first = dr.opaque(mi.UInt32, first)

        def footprint(self, query: Any, xi: Any) -> Any:
            pixel = query + self.first
            jitter = mi.warp.square_to_std_normal(xi) * PIXEL_SIGMA
            row = pixel // columns
            x = (mi.Float(pixel - row * columns) - center_x + jitter.x) * pitch
            y = (center_y - mi.Float(row) + jitter.y) * pitch
            d = forward + right * x + up * y
            # The filter's tail may reach the horizon, with negligible weight.
            t = position.z / dr.maximum(-d.z, 1e-4)
            return mi.Point2f(position.x + t * d.x, (position.y + t * d.y) / aspect)

        def ray(self, query: Any, point: Any) -> Any:
            towards = mi.Vector3f(position.x - point.x, position.y - point.y * aspect, position.z)
            return ray_through(point, dr.normalize(towards), unit, aspect, start)

    return CameraRays()


def picture_seconds(estimator: Estimator, camera: Camera, omega_i: NDArray[np.float64], paths: int) -> float:
    """Seconds to trace so many paths, measured by a small picture of the same view."""
    small, spp = replace(camera, rows=64, columns=64), 128
    seconds = 0.0
    for _ in range(2):  # the first one compiles
        start = time.perf_counter()
        render_reference(estimator, small, omega_i, spp=spp)
        seconds = time.perf_counter() - start
    return seconds * paths / (small.rows * small.columns * spp)


def render_reference(
    estimator: Estimator,
    camera: Camera,
    omega_i: NDArray[np.float64],
    *,
    kind: PixelKind = "query",
    spp: int = 256,
    seed: int = 0,
    index: int = 0,
) -> ReferenceImage:
    """Render one picture of the tile.

    Parameters
    ----------
    estimator : Estimator
        Estimator of the tile.
    camera : Camera
        The camera.
    omega_i : (3,) float array
        Direction towards the light.
    kind : {"query", "pixel"}
        Meaning of a pixel, see :mod:`mbtf_core.pictures`.
    spp : int
        Paths per pixel, both halves together; even.
    seed, index : int
        Root seed of the random numbers, and number of the picture.

    Returns
    -------
    ReferenceImage
        The picture and its queries.

    Raises
    ------
    UsageError
        The picture shows the horizon.
    """
    from mbtf_gen.render.estimator import Stream

    queries = camera.queries(omega_i, estimator.tile.aspect)
    source = _camera_rays(camera, estimator) if kind == "pixel" else None
    stream = Stream(seed, "reference", 2 * index + (kind == "pixel"))
    estimates = estimator.estimate(queries.flat(), spp, stream, source)
    shape, through = (*queries.lead, 3), estimates.transmittance
    return ReferenceImage(
        kind,
        camera,
        queries,
        estimates.value_a.reshape(shape),
        estimates.value_b.reshape(shape),
        spp,
        None if through is None else through.reshape(queries.lead),
    )
