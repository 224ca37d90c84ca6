"""Small scenes that several physics tests share, and shorthands to estimate M on them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from mbtf_gen.config.generator import Tracer
from mbtf_gen.engine.runtime import load_mitsuba
from support.paths import ROOT

mi = load_mitsuba()

from mbtf_core.data.schema import Queries  # noqa: E402
from mbtf_gen.render.estimates import Estimates, Stream  # noqa: E402
from mbtf_gen.render.estimator import Estimator  # noqa: E402
from mbtf_gen.render.path_tracer import Transport  # noqa: E402
from mbtf_gen.render.scene import build_scene, register_plugins  # noqa: E402
from mbtf_gen.sampling.light_kernel import LightKernel  # noqa: E402
from mbtf_gen.tile.heights import HeightGrid, grid_faces, grid_vertices  # noqa: E402

register_plugins()

DIRECT = Transport(max_depth=1)


def lambert(albedo: float | tuple[float, float, float]) -> dict[str, Any]:
    """Mitsuba dictionary of a Lambert reflector."""
    value = [albedo] * 3 if isinstance(albedo, float) else list(albedo)
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": value}}


def flat(aspect: float = 1.0) -> HeightGrid:
    """A plane."""
    return HeightGrid(np.zeros((4, 4)), aspect)


def rocks(resolution: int = 64, displacement_range: float = 0.15, seed: int = 3) -> HeightGrid:
    """A rough, periodic, asymmetric height field with steep flanks."""
    rng = np.random.default_rng(seed)
    frequency = np.fft.fftfreq(resolution, 1.0 / resolution)
    radius = np.hypot(frequency[:, None], frequency[None, :])
    spectrum = np.exp(2j * np.pi * rng.random((resolution, resolution))) * np.exp(-((radius / 6.0) ** 2))
    h = np.fft.ifft2(spectrum).real
    h = (h - h.min()) / (h.max() - h.min())
    # Terraces: flat tops, steep flanks, a tilt that breaks every symmetry.
    h = 0.7 * np.floor(5.0 * h) / 5.0 + 0.3 * h
    return HeightGrid.from_map(h, displacement_range / (h.max() - h.min()))


def real_heights(name: str, resolution: int = 96) -> HeightGrid:
    """Height grid of a real material: ``turtle_shell`` of the assets, or a set in ``../shared/data`` beside
    the project.

    The test is skipped, by name, where the set is not there.
    """
    from mbtf_gen.tile.loading import load_material

    root = ROOT
    folder = root / "assets" / name
    height = None
    if not folder.exists():
        folder = root.parent / "shared" / "data" / "materials" / name
        height = 0.15
        if not folder.exists():
            pytest.skip(f"{name} is not beside the project")
    return load_material(folder).at(height, resolution).grid


def queries(u: ArrayLike, sigma: ArrayLike, omega_i: ArrayLike, omega_o: ArrayLike, n: int) -> Queries:
    """n queries; arguments broadcast over them."""

    def rows(x: ArrayLike, trailing: tuple[int, ...]) -> NDArray[np.float32]:
        return np.broadcast_to(np.asarray(x, np.float32), (n, *trailing)).copy()

    return Queries(rows(u, (2,)), rows(sigma, ()), rows(omega_i, (3,)), rows(omega_o, (3,)))


def tile_mean_queries(omega_i: ArrayLike, omega_o: ArrayLike, n: int, seed: int = 0) -> Queries:
    """n queries with footprints of four tile widths: each of them, and so their mean, is the tile mean."""
    return queries(np.random.default_rng(seed).random((n, 2)), 4.0, omega_i, omega_o, n)


def estimate(
    grid: HeightGrid,
    bsdf: Any,
    light: LightKernel | None,
    q: Queries,
    spp: int,
    *,
    transport: Transport | None = None,
    seed: int = 1,
    tracer: Tracer = "heightfield",
) -> Estimates:
    """Both halves of M at the queries."""
    estimator = Estimator(build_scene(replace(grid, tracer=tracer), bsdf), light, transport or Transport())
    return estimator.estimate(q, spp, Stream(seed, "test", 0))


def mesh_of_grid(grid: HeightGrid, unit: float, apron: tuple[int, int], bsdf: Any) -> Any:
    """Mitsuba mesh of one period of the tile centered on the origin, with `unit` scene units per tile width
    and an `apron` of (rows, columns) cells on each side."""
    vertices = grid_vertices(grid, apron)
    flat, faces = vertices.reshape(-1, 3), grid_faces(*vertices.shape[:2])
    props = mi.Properties()
    props["bsdf"] = bsdf
    # Interpolated normals lose energy on coarse grids.
    props["face_normals"] = True
    mesh = mi.Mesh("tile", len(flat), len(faces), props=props, has_vertex_texcoords=True)
    params = mi.traverse(mesh)
    centered = (flat - (0.5, 0.5 * grid.aspect, 0.0)) * unit
    params["vertex_positions"] = centered.astype(np.float32).ravel()
    # Mitsuba's bitmaps have row 0 at v = 0, ours at v → 1: its texture coordinates are (u, 1-v).
    texcoords = np.column_stack([flat[:, 0], 1.0 - flat[:, 1] / grid.aspect])
    params["vertex_texcoords"] = texcoords.astype(np.float32).ravel()
    params["faces"] = faces.ravel()
    params.update()
    return mesh


def direction(elevation: float, azimuth: float) -> NDArray[np.float64]:
    """Unit vector from angles in degrees."""
    from mbtf_core.directions import from_angles

    return from_angles(elevation, azimuth)


def directional(omega_i: NDArray[np.float64]) -> dict[str, Any]:
    """Delta light from `omega_i` with irradiance 1 on z = 0, from above or from below."""
    towards = [-float(c) for c in omega_i]
    return {"type": "directional", "direction": towards, "irradiance": float(1 / abs(omega_i[2]))}
