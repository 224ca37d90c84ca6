"""Planes with a fitted material in Mitsuba, under any texture coordinates, light and camera."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

import mbtf_fit.backends.mitsuba
from mbtf_core.pictures import Camera

from .scenes import mi

mbtf_fit.backends.mitsuba.register()


def plane(bsdf: dict[str, Any], to_uv: Any = None, aspect: float = 1.0, half: float = 200.0) -> Any:
    """Square mesh in z = 0 whose texture coordinates are ``to_uv @ (x, y, 1)``.

    By default a tile lies from (0, 0) to (1, aspect) as the contract has it: row 0 of its images at the top,
    where Mitsuba's v is 0.
    """
    matrix = np.array([[1.0, 0, 0], [0, -1.0, aspect]]) if to_uv is None else np.asarray(to_uv, np.float64)
    corners = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
    uv = corners @ matrix[:, :2].T + matrix[:, 2]
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh("plane", 4, 2, has_vertex_texcoords=True, props=props)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.concatenate([corners, np.zeros((4, 1))], 1).astype(np.float32).ravel()
    parameters["faces"] = np.array([0, 1, 2, 0, 2, 3], np.uint32)
    parameters["vertex_texcoords"] = uv.astype(np.float32).ravel()
    parameters.update()
    return mesh


def interaction(n: int, wi: tuple[float, float, float], **fields: Any) -> Any:
    """`n` hits on a plane with the normal z, seen from `wi`."""
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.n = mi.Normal3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(si.n)
    si.wi = dr.normalize(mi.Vector3f(*wi))
    for name, value in fields.items():
        setattr(si, name, value)
    return si


def sensor_of(camera: Camera, spp: int = 1) -> dict[str, Any]:
    """The same camera as a sensor of Mitsuba."""
    target = np.array([*camera.target, 0.0])
    _, _, up = camera.frame()
    lists = [[float(c) for c in v] for v in (camera.position, target, up)]
    return {
        "type": "perspective",
        "fov": camera.field_of_view,
        "fov_axis": "x",
        "to_world": mi.ScalarTransform4f().look_at(*lists),
        "film": {
            "type": "hdrfilm",
            "width": camera.columns,
            "height": camera.rows,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
        },
        "sampler": {"type": "independent", "sample_count": spp},
    }


def through_pixel_centers(
    scene: Any, camera: Camera, integrator: Any, samples: int = 1
) -> NDArray[np.float64]:
    """Means of what an integrator answers for rays through the pixels' centers, (rows, columns, 3)."""
    n = camera.rows * camera.columns * samples
    index = dr.arange(mi.UInt32, n) // samples
    at = mi.Point2f(
        (mi.Float(index % camera.columns) + 0.5) / camera.columns,
        (mi.Float(index // camera.columns) + 0.5) / camera.rows,
    )
    ray, _ = scene.sensors()[0].sample_ray_differential(0.0, 0.5, at, mi.Point2f(0.5, 0.5))
    sampler = mi.load_dict({"type": "independent", "sample_count": 1})
    sampler.seed(0, n)
    value, _, _ = integrator.sample(scene, sampler, ray)
    return np.array(value, np.float64).T.reshape(camera.rows, camera.columns, samples, 3).mean(2)
