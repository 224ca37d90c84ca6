"""Displaced shapes, path-traced by unmodified Mitsuba: what a material on a curved object should look like.

The tiles of a shape are conformal: square everywhere, with a width s that varies over it. The widest are as
wide as a tile of the plane, the unit of length. The surface is the top of the material, as on the plane: a
point (x, y) of the tiles lies at ``p + s z n``, z ≤ 0. N tiles around, with ``R = N/2π``:

- cylinder: radius R, N tiles long, s = 1;
- sphere: radius R, a Mercator projection up to 84° of latitude, s the cosine of the latitude;
- torus: outer radius R; a tube of M ≈ N/2 tiles around, whose ratio of radii is r/R₀ = k/√(1+k²), k = M a/N.

The axis of a shape is z. A picture shows radiance in 1/sr under a distant light of irradiance 1 across its
rays, as wide as that of the data, and no background. Opacity and normal maps are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError, UsageError
from mbtf_core.pictures import PIXEL_SIGMA, Camera, ReferenceImage
from mbtf_gen.config.pictures import Shape
from mbtf_gen.planning.job import Job
from mbtf_gen.sampling.light_kernel import LightKernel
from mbtf_gen.tile.heights import MOST_CELLS, HeightGrid, grid_faces

F64 = NDArray[np.float64]
# Latitude beyond which the sphere's tiles no longer shrink.
_STEEPEST = np.radians(84.0)


@dataclass(frozen=True)
class Chart:
    """A shape with tiles.

    Attributes
    ----------
    name : of the shape
    around : tiles around the axis
    aspect : height of a tile over its width
    """

    name: Shape
    around: int
    aspect: float

    @property
    def radius(self) -> float:
        """Largest distance from the axis, in tile widths."""
        return self.around / (2.0 * np.pi)

    @property
    def along(self) -> tuple[float, float]:
        """Range of y, in tile widths; that of a torus has whole tiles."""
        if self.name == "torus":
            return 0.0, max(1, round(self.around / (2.0 * self.aspect))) * self.aspect
        if self.name == "cylinder":
            return -0.5 * self.around, 0.5 * self.around
        pole = np.arctanh(np.sin(_STEEPEST)) + (np.pi / 2 - _STEEPEST) / np.cos(_STEEPEST)
        return -self.radius * float(pole), self.radius * float(pole)

    def at(self, x: F64, y: F64) -> tuple[F64, F64, F64]:
        """Positions (..., 3), outward normals (..., 3) and widths of a tile (...) at places of the tiles, all
        lengths in tile widths."""
        azimuth, north = np.broadcast_arrays(x / self.radius, y / self.radius)
        if self.name == "cylinder":
            n = _around(azimuth, np.ones_like(north), np.zeros_like(north))
            return _around(azimuth, np.full_like(north, self.radius), y + 0.0 * north), n, np.ones_like(north)
        if self.name == "sphere":
            turn = np.arctanh(np.sin(_STEEPEST))
            beyond = np.clip(np.abs(north) - turn, 0.0, None) * np.cos(_STEEPEST)
            latitude = np.arctan(np.sinh(np.clip(north, -turn, turn))) + np.sign(north) * beyond
            n = _around(azimuth, np.cos(latitude), np.sin(latitude))
            return self.radius * n, n, np.cos(np.clip(latitude, -_STEEPEST, _STEEPEST))
        k = self.along[1] / self.around
        share = k / np.sqrt(1.0 + k * k)
        major = self.radius / (1.0 + share)
        # With r = share: dy/R = r dθ / (1 + r cos θ), whose integral over the tube is 2π k.
        half = np.pi * (y / self.along[1] - 0.5) + 0.0 * north
        angle = 2.0 * np.arctan2(np.sqrt(1.0 + share) * np.sin(half), np.sqrt(1.0 - share) * np.cos(half))
        n = _around(azimuth, np.cos(angle), np.sin(angle))
        from_axis = major * (1.0 + share * np.cos(angle))
        return _around(azimuth, from_axis, major * share * np.sin(angle)), n, from_axis / self.radius

    def mesh(self, grid: HeightGrid | None, bsdf: Any, cells: int = 32) -> Any:
        """The displaced shape as a mesh of Mitsuba; without heights smooth surface, of `cells` per tile.

        Texture coordinates are in tile widths over (1, aspect), v downwards.

        Raises
        ------
        InputError : too many triangles
        """
        rows, columns = (round(cells * self.aspect), cells) if grid is None else grid.z.shape
        low, high = (round(end / self.aspect * rows) for end in self.along)
        across = self.around * columns
        check_cells(self.name, (high - low) * across, columns)
        i, j = np.arange(across + 1), np.arange(low, high + 1)
        x, y = (i + 0.5) / columns, ((j + 0.5) / rows) * self.aspect
        p, n, width = self.at(x[None], y[:, None])
        if grid is not None:
            z = grid.z[::-1][np.ix_(j % rows, i % columns)]
            p = p + (width * z)[..., None] * n
        uv = np.stack(np.broadcast_arrays(x[None], 1.0 - y[:, None] / self.aspect), -1)
        # Rows of :func:`grid_faces` run downwards.
        order = slice(None, None, -1)
        faces, normals = grid_faces(*p.shape[:2]), None if grid is not None else n[order].reshape(-1, 3)
        position, texture = p[order].reshape(-1, 3), uv[order].reshape(-1, 2)
        return mitsuba_mesh("shape", bsdf, position, texture, faces, normals, flat=normals is None)


def _around(azimuth: F64, radius: F64, z: F64) -> F64:
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], -1)


def check_cells(surface: str, count: int, columns: int) -> None:
    """Refuse a displaced surface of too many cells, for tiles of so many columns."""
    if count > MOST_CELLS:
        raise InputError(
            f"the {surface} has {count:,} cells; at most {MOST_CELLS:,} can be traced",
            where="--mesh",
            hint=f"give --mesh {int(columns * (MOST_CELLS / count) ** 0.5)}, or fewer --tiles-per-uv",
        )


def mitsuba_mesh(
    name: str, bsdf: Any, position: F64, uv: F64, faces: Any, normals: F64 | None = None, flat: bool = False
) -> Any:
    """A mesh of Mitsuba, of vertices (n, 3), uv (n, 2) and triangles (m, 3), with vertex normals (n, 3) or
    `flat` ones of faces; its BSDF may be a dictionary."""
    import mitsuba as mi

    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf) if isinstance(bsdf, dict) else bsdf
    props["face_normals"] = flat
    mesh = mi.Mesh(
        name,
        len(position),
        len(faces),
        has_vertex_normals=normals is not None,
        has_vertex_texcoords=True,
        props=props,
    )
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = position.astype(np.float32).ravel()
    parameters["vertex_texcoords"] = uv.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    if normals is not None:
        parameters["vertex_normals"] = normals.astype(np.float32).ravel()
    parameters.update()
    return mesh


def shape_scene(
    mesh: Any,
    camera: Camera,
    omega_i: NDArray[Any],
    integrator: dict[str, Any],
    light: dict[str, Any] | None = None,
) -> Any:
    """A scene of Mitsuba: a shape around the origin that the camera looks at, no background, and a light; by
    default a distant one of irradiance 1."""
    import mitsuba as mi

    forward, _, up = camera.frame()
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"hide_emitters": True, **integrator},
            "sensor": {
                "type": "perspective",
                "fov": camera.field_of_view,
                "fov_axis": "x",
                "to_world": mi.ScalarTransform4f().look_at(
                    (-camera.distance * forward).tolist(), [0.0, 0.0, 0.0], up.tolist()
                ),
                "sampler": {"type": "independent"},
                "film": {
                    "type": "hdrfilm",
                    "width": camera.columns,
                    "height": camera.rows,
                    "rfilter": {"type": "gaussian", "stddev": PIXEL_SIGMA},
                    "pixel_format": "rgba",
                    "component_format": "float32",
                    "sample_border": True,
                },
            },
            "light": light or {"type": "directional", "direction": (-omega_i).tolist(), "irradiance": 1.0},
            "shape": mesh,
        }
    )


def render_shape(
    source: Job,
    displaced: Callable[[HeightGrid, Any], Any],
    camera: Camera,
    omega_i: NDArray[Any],
    spp: int = 256,
    seed: int = 0,
    index: int = 0,
    max_depth: int = -1,
) -> ReferenceImage:
    """Path-trace a displaced surface with Mitsuba's own path tracer.

    Parameters
    ----------
    displaced : the mesh of Mitsuba of heights and a BSDF, such as :meth:`Chart.mesh`
    camera, omega_i : looks at the origin; unit vector (3,) towards the light
    spp : paths per pixel, both halves together; even
    seed, index : root seed of the random numbers, and number of the picture
    max_depth : longest path in segments; 2 is direct light, -1 has no limit

    Raises
    ------
    UsageError : the material is no height field of maps
    InputError : too many triangles
    """
    from mbtf_gen.engine.runtime import load_mitsuba

    load_mitsuba()
    from mbtf_gen.render.scene import register_plugins

    register_plugins()
    material = source.material.with_maps(opacity=None)
    grid, bsdf = material.grid, material.surface()
    if grid is None or not isinstance(bsdf, dict):
        raise UsageError("displaces height maps only", where="--surface")
    path = {"type": "path", "max_depth": max_depth, "rr_depth": 8}
    width = source.config.light.width
    light = {"type": "mbtf_directional", "direction": omega_i.tolist(), "width": width}
    scene = shape_scene(displaced(grid, bsdf), camera, omega_i, path, light)
    # The light has unit irradiance on a plane.
    across = float(LightKernel(width).irradiance(omega_i[None])[0])
    image = render_scene(scene, spp, [seed, index])
    return replace(image, value_a=across * image.value_a, value_b=across * image.value_b)


def render_scene(scene: Any, spp: int, seed: Sequence[int]) -> ReferenceImage:
    """Two halves of a picture of :func:`shape_scene`, with `spp`/2 paths per pixel each."""
    import mitsuba as mi

    seeds = np.random.default_rng([*seed, 2]).integers(1 << 31, size=2)
    a, b = (np.array(mi.render(scene, spp=max(1, spp // 2), seed=int(s)), np.float32) for s in seeds)
    return ReferenceImage(a[..., :3], b[..., :3], spp, 1.0 - 0.5 * (a + b)[..., 3])
