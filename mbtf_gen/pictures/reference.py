"""Reference pictures: path-traced from the micro-geometry, with both halves.

A picture is stored as an EXR image with the channels of the shard schema (``u.x``, ``omega_o.z``,
``value_a.R``, …), so that a fitted material can be evaluated at its queries, and as a PNG for display.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.atomic import read_json, write_file
from mbtf_core.errors import InputError
from mbtf_core.exposure import to_display
from mbtf_core.suggest import suggest_path
from mbtf_gen.dataset.shard_io import read_exr, write_exr
from mbtf_gen.pictures.camera import PIXEL_SIGMA, Camera, PixelKind
from mbtf_gen.pictures.folder import RECORD_NAME
from mbtf_gen.sampling.query_sampler import Queries

if TYPE_CHECKING:
    from mbtf_gen.render.estimator import Estimator

# Of an 8-bit pixel, at most.
PNG_BYTES = 3


@dataclass(frozen=True)
class ReferenceImage:
    """A rendered picture.

    Attributes
    ----------
    kind : {"query", "pixel"}
        Meaning of a pixel, see :mod:`mbtf_gen.pictures.camera`.
    camera : Camera
        The camera.
    queries : Queries
        One per pixel, with leading axes (rows, columns).
    value_a, value_b : (rows, columns, 3) float32 array
        Independent halves, in 1/sr.
    spp : int
        Paths per pixel, both halves together.
    transmittance : (rows, columns) float32 array or None
        Fraction of the view rays that the opacity mask transmits; None without a mask.
    """

    kind: PixelKind
    camera: Camera
    queries: Queries
    value_a: NDArray[np.float32]
    value_b: NDArray[np.float32]
    spp: int
    transmittance: NDArray[np.float32] | None = None

    @property
    def value(self) -> NDArray[np.float32]:
        """Mean of the halves, (rows, columns, 3)."""
        return 0.5 * (self.value_a + self.value_b)

    def write(self, path: Path) -> Path:
        """Write ``path`` + ``.exr`` with all channels, atomically, and return its path."""
        spp = np.full(self.queries.lead, self.spp, np.float32)
        arrays = {**vars(self.queries), "value_a": self.value_a, "value_b": self.value_b, "spp": spp}
        if self.transmittance is not None:
            arrays["transmittance"] = self.transmittance
        exr = path.with_name(f"{path.name}.exr")
        write_exr(exr, {name: array[None] for name, array in arrays.items()})
        return exr


def read_references(folder: Path) -> list[tuple[NDArray[np.float32], Camera, NDArray[np.float32]]]:
    """Value in 1/sr, camera, and direction of the light of the finished pictures of ``mbtf-gen reference``.

    Parameters
    ----------
    folder : Path
        Output folder of the command.

    Returns
    -------
    list of (array (rows, columns, 3), Camera, array (3,))

    Raises
    ------
    InputError
        The folder has no such pictures.
    """
    record = folder / RECORD_NAME
    if not record.is_file():
        hint = suggest_path(folder, Path.is_dir)
        raise InputError("holds no pictures of mbtf-gen reference", where=folder, hint=hint)
    known = read_json(record)
    options = known.get("depends", {}).get("reference", {})
    if known.get("kind") != "reference" or not {"view", "light", "tiles_across"} <= set(options):
        raise InputError("holds no pictures of mbtf-gen reference", where=folder)
    out = []
    for across in options["tiles_across"]:
        name = next((n for n in known["pictures"] if n.endswith(f"-tiles{across:g}")), None)
        if name is None:
            continue
        path = folder / f"{name}.exr"
        value, light = read_value(path), read_exr(path, ("omega_i",))["omega_i"].reshape(-1, 3)[0]
        rows, columns = value.shape[:2]
        view = options["view"]
        out.append(
            (value, Camera(view["elevation"], view["azimuth"], across, rows=rows, columns=columns), light)
        )
    if not out:
        raise InputError("holds no finished picture", where=folder, hint="run mbtf-gen reference again")
    return out


def read_value(path: Path) -> NDArray[np.float32]:
    """Value (rows, columns, 3) of a picture that :meth:`ReferenceImage.write` wrote."""
    stored = read_exr(path, ("value_a", "value_b"))
    value: NDArray[np.float32] = 0.5 * (stored["value_a"] + stored["value_b"])
    return value.reshape(value.shape[-3:])


def write_display(path: Path, value: NDArray[np.float32], exposure: float) -> Path:
    """Write ``path`` + ``.png``, sRGB of a linear picture at an exposure in EV, and return its path."""
    png = path.with_name(f"{path.name}.png")
    write_png(png, to_display(value, exposure))
    return png


def write_png(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Write an 8-bit picture (rows, columns, 3), atomically."""
    from PIL import Image

    write_file(path, lambda stream: Image.fromarray(pixels).save(stream, format="PNG"))


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
        Meaning of a pixel, see :mod:`mbtf_gen.pictures.camera`.
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
