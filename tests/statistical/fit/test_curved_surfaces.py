"""A material with silhouettes on curved shapes, against displaced geometry that Mitsuba path-traces."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from support.plugin_materials import write_material

from mbtf_core.data.geometry import Geometry
from mbtf_core.data.lattice import Lattice
from mbtf_core.directions import from_angles
from mbtf_core.pictures import Camera, ReferenceImage
from mbtf_fit.backends.mitsuba import register
from mbtf_fit.surface.known import KnownSurface
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.pictures.shapes import Chart, render_scene, render_shape, shape_scene
from mbtf_gen.planning.job import Job

register("llvm_ad_rgb")

LEVEL, DEPTH, SIZE, SPP = 5, 0.25, 96, 32
LIGHT = from_angles(35.0, -50.0)


@pytest.fixture(scope="module")
def bumps(tmp_path_factory: pytest.TempPathFactory) -> tuple[Job, Path]:
    """Smooth bumps of a Lambert surface: the job that path-traces them, and the material of their direct
    light alone."""
    folder = tmp_path_factory.mktemp("bumps")
    x, y = np.meshgrid(*2 * [(np.arange(2**LEVEL) + 0.5) / 2**LEVEL])
    z = np.sin(4 * np.pi * x) * np.cos(4 * np.pi * y) + 0.3 * np.sin(2 * np.pi * (x + y))
    z = DEPTH * (z - z.max()) / np.ptp(z)
    np.save(folder / "heights.npy", z.astype(np.float32))
    job = Job.load(GeneratorConfig(material=str(folder / "heights.npy"), geometry={"height_scale": 1.0}))
    lattice = Lattice(LEVEL)
    geometry = Geometry.of_heights(z.astype(np.float32), 1.0)
    known = KnownSurface.of(geometry, lattice, 0.0)
    write_material(folder / "material", model="relief", finest=LEVEL, constant=(0.3,) * 3, known=known)
    return job, folder / "material"


def picture(shape: str, around: int, bumps: tuple[Job, Path], camera: Camera, **bsdf: Any) -> ReferenceImage:
    """The material on the smooth shape."""
    material = {"type": "mbtf", "material": str(bumps[1]), **bsdf}
    mesh = Chart(shape, around, 1.0).mesh(None, material, 48)
    path = {"type": "mbtf_path", "max_depth": 3, "rr_depth": 8}
    return render_scene(shape_scene(mesh, camera, LIGHT, path), SPP, [1])


def outline(image: ReferenceImage) -> NDArray[np.bool_]:
    """Pixels at the border of what the shape covers."""
    inside = np.pad(image.transmittance < 0.5, 1)
    around = [np.roll(inside, step, axis) for axis in (0, 1) for step in (-1, 1)]
    return (inside & ~np.logical_and.reduce(around))[1:-1, 1:-1]


def outline_distance(a: ReferenceImage, b: ReferenceImage) -> float:
    """Mean distance of two outlines in pixels."""
    lines = outline(a), outline(b)
    return float(np.mean([distance_transform_edt(~x)[y].mean() for x, y in (lines, lines[::-1])]))


def blocks(image: ReferenceImage) -> NDArray[np.float64]:
    """Means of 16 × 16 pixels."""
    gray = image.value.mean(-1).astype(np.float64)
    return gray.reshape(SIZE // 16, 16, -1, 16).mean((1, 3))


@pytest.mark.parametrize("shape", ["sphere", "cylinder"])
def test_a_curved_shape_looks_like_displaced_geometry(shape: str, bumps: tuple[Job, Path]) -> None:
    """Of a radius of 1.1 tiles, four times the depth of the bumps."""
    around = 7
    camera = Camera(25.0, -90.0, 1.15 * around / np.pi, rows=SIZE, columns=SIZE)
    expected = render_shape(bumps[0], Chart(shape, around, 1.0).mesh, camera, LIGHT, SPP, max_depth=2)
    found = picture(shape, around, bumps, camera, silhouettes=True)
    smooth = picture(shape, around, bumps, camera)
    assert outline_distance(found, expected) < 0.5
    assert outline_distance(smooth, expected) > 1.0
    mean = expected.value.mean()
    # The material has the known surface alone, nothing that is learned of its light.
    assert found.value.mean() == pytest.approx(mean, rel=0.04)
    errors = [np.sqrt(((blocks(x) - blocks(expected)) ** 2).mean()) / mean for x in (found, smooth)]
    assert errors[0] < min(0.085, 0.7 * errors[1])
