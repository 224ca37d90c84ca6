"""A material that displaces a mesh, against shapes in closed form and against its mirror image."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.scenes import mi
from support.unmodified_mitsuba import agree, differences

from mbtf_core.directions import from_angles
from mbtf_core.pictures import Camera, ReferenceImage
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.config.pictures import Shape
from mbtf_gen.pictures.displaced_mesh import DisplacedMesh
from mbtf_gen.pictures.shapes import Chart, render_shape
from mbtf_gen.planning.job import Job

SIZE, SPP = 72, 32
F64 = NDArray[np.float64]


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Job:
    """Asymmetric bumps whose slopes are as steep as those of rocks."""
    path = tmp_path_factory.mktemp("bumps") / "heights.npy"
    x, y = np.meshgrid(*2 * [(np.arange(24) + 0.5) / 24])
    z = np.sin(4 * np.pi * x + np.cos(2 * np.pi * y)) * np.cos(4 * np.pi * y) + 0.3 * np.sin(2 * np.pi * x)
    np.save(path, (0.06 * z).astype(np.float32))
    return Job.load(GeneratorConfig(material=str(path), geometry={"height_scale": 1.0}))


def written(path: Path, position: F64, uv: F64, faces: F64) -> DisplacedMesh:
    """A mesh that was in a file, v up."""
    lines = [f"v {a:.9g} {b:.9g} {c:.9g}" for a, b, c in position]
    lines += [f"vt {a:.9g} {b:.9g}" for a, b in uv]
    lines += ["f " + " ".join(f"{k + 1}/{k + 1}" for k in face) for face in faces]
    path.write_text("\n".join(lines) + "\n")
    return DisplacedMesh.read(path, 1.0, 1.0, "z")


def halves(image: ReferenceImage) -> tuple[F64, F64]:
    """Those of a picture."""
    return image.value_a.astype(np.float64), image.value_b.astype(np.float64)


@pytest.mark.parametrize(("shape", "around"), [("sphere", 5), ("torus", 10)])
def test_a_mesh_of_a_shape_looks_like_the_shape(shape: Shape, around: int, job: Job, tmp_path: Path) -> None:
    chart = Chart(shape, around, 1.0)
    parameters = mi.traverse(chart.mesh(None, {"type": "diffuse"}, 16))
    p, uv, faces = (
        np.array(parameters[name]).reshape(-1, columns)
        for name, columns in (("vertex_positions", 3), ("vertex_texcoords", 2), ("faces", 3))
    )
    mesh = written(tmp_path / "shape.obj", p, uv * (1.0, -1.0) + (0.0, 1.0), faces)
    across, light = 1.25 * around / np.pi, from_angles(35.0, -50.0)
    scale = mesh.radius / float(np.linalg.norm(p, axis=1).max())
    cameras = [Camera(25.0, -90.0, across * r, rows=SIZE, columns=SIZE) for r in (1.0, scale)]
    expected, found = (
        render_shape(job, surface.mesh, camera, light, SPP, seed, max_depth=2)
        for seed, (surface, camera) in enumerate(zip((chart, mesh), cameras, strict=True))
    )
    mean, square = differences(halves(found), halves(expected))
    assert agree(mean, square), (mean, square)


def test_a_mirrored_chart_gives_the_mirrored_picture(job: Job, tmp_path: Path) -> None:
    """Of a wavy sheet with sheared texture coordinates, its mirror image has the same ones."""
    x, y = (a.ravel() for a in np.meshgrid(*2 * [np.linspace(-1.5, 1.5, 41)]))
    p = np.stack([x, y, 0.3 * np.sin(2 * x + y)], -1)
    uv = np.stack([x + 0.4 * y, 0.8 * y], -1)
    corner = (np.arange(40)[:, None] * 41 + np.arange(40)).ravel()
    faces = np.concatenate([corner[:, None] + offsets for offsets in ([0, 1, 42], [0, 42, 41])])
    pictures = []
    for seed, sign in enumerate((1.0, -1.0)):
        mesh = written(tmp_path / "sheet.obj", p * (sign, 1.0, 1.0), uv, faces[:, :: int(sign)])
        camera = Camera(50.0, 90.0 - 60.0 * sign, 5.0, rows=SIZE, columns=SIZE)
        light = from_angles(30.0, 90.0 - 130.0 * sign)
        pictures.append(halves(render_shape(job, mesh.mesh, camera, light, SPP, seed, max_depth=2)))
    mirrored = pictures[1][0][:, ::-1], pictures[1][1][:, ::-1]
    assert agree(*differences(pictures[0], mirrored))
    assert not agree(*differences(*pictures))
