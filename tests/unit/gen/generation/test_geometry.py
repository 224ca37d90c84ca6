"""``geometry.exr``: closed forms of its slopes and moments, what it leaves out, and its file."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.datasets import flip, write_dataset
from support.height_maps import slope_normals

from mbtf_core.data.geometry import (
    CLEARCOAT,
    GLOSSY,
    Geometry,
    encode_geometry,
    geometry_record,
    read_geometry,
)
from mbtf_core.errors import InputError
from mbtf_core.images.exr import encode_parts
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.planning.job import Job
from mbtf_gen.planning.run_plan import reference_plan
from mbtf_gen.planning.simulation import geometry_of
from mbtf_gen.tile.loading import load_material

F64 = NDArray[np.float64]
SQUARE = (64, 64)


def job_of(folder: Path, heights: F64, finest: int = 3, effects: str = "auto", **maps: Any) -> Job:
    """Job of stored heights, whose material gets `maps`."""
    np.save(folder / "height.npy", heights)
    config = GeneratorConfig.model_validate(
        {
            "material": str(folder / "height.npy"),
            "queries": {"resolution": 1 << finest},
            "effects": {"mode": effects, "normal": "absolute"},
        }
    )
    material = load_material(config.material)
    bsdf = maps.pop("bsdf", None)
    return Job.of(config, replace(material.with_maps(**maps), bsdf=bsdf))


def made(job: Job) -> Geometry:
    return geometry_of(job, reference_plan(job))


def centers(rows: int, columns: int) -> tuple[F64, F64]:
    """x (1, columns) and y (rows, 1) of the texel centers in tile widths; row 0 is the side ``v → 1``."""
    x, y = (np.arange(columns) + 0.5) / columns, rows / columns * (1 - (np.arange(rows) + 0.5) / rows)
    return x[None, :], y[:, None]


def normals(sx: F64, sy: F64) -> NDArray[np.float32]:
    """Unit normals (h, w, 3) of a surface with these slopes: it rises against them."""
    return slope_normals(np.stack(np.broadcast_arrays(sx, sy), axis=-1)).astype(np.float32)


@pytest.mark.parametrize("shape", [(256, 256), (128, 256), (360, 240)])
def test_slopes_of_a_wave_are_its_differences(shape: tuple[int, int], tmp_path: Path) -> None:
    """A wave without any symmetry; the mean of a derivative is the difference over the texel's ends."""
    aspect = shape[0] / shape[1]
    kx, ky = 2 * np.pi, 2 * np.pi * 2 / aspect

    def along_x(x: F64) -> F64:
        return 0.03 * np.sin(kx * x + 0.4)

    def along_y(y: F64) -> F64:
        return 0.02 * np.sin(ky * y + 0.9)

    x, y = centers(*shape)
    found = made(job_of(tmp_path, along_x(x) + along_y(y), finest=3))
    assert found.slopes.shape == (round(16 * aspect), 16, 2)
    x, y = centers(*found.slopes.shape[:2])
    half, half_y = 0.5 / 16, 0.5 * aspect / len(y)
    slope_x = np.broadcast_to((along_x(x + half) - along_x(x - half)) / (2 * half), found.slopes.shape[:2])
    slope_y = np.broadcast_to((along_y(y + half_y) - along_y(y - half_y)) / (2 * half_y), slope_x.shape)
    np.testing.assert_allclose(found.slopes[..., 0], slope_x, atol=2e-3 * np.abs(slope_x).max())
    np.testing.assert_allclose(found.slopes[..., 1], slope_y, atol=2e-3 * np.abs(slope_y).max())
    # The two waves are independent, so that the mean of the product is the product of the means.
    np.testing.assert_allclose(found.slope_moments[..., 1], slope_x * slope_y, atol=2e-4)


def test_moments_keep_detail_below_a_texel(tmp_path: Path) -> None:
    """Waves of four periods per texel: no mean slope, variance a²/2, b²/2, and ab/2 for waves in step."""
    phase = 2 * np.pi * 64 * centers(256, 256)[0]
    a, b = 0.4, 0.15
    # A displaced mesh of lower resolution takes nothing away.
    heights = 1e-9 * np.random.default_rng(0).random(SQUARE)
    for sy, product in ((b * np.sin(phase), a * b / 2), (b * np.cos(phase), 0.0)):
        maps = {"normal": normals(np.broadcast_to(a * np.sin(phase), (256, 256)), sy)}
        found = made(job_of(tmp_path, heights, **maps))
        np.testing.assert_allclose(found.slopes, 0.0, atol=1e-6)
        expected = np.broadcast_to([a * a / 2, product, b * b / 2], (16, 16, 3))
        np.testing.assert_allclose(found.slope_moments, expected, atol=1e-6)


@pytest.mark.parametrize("mesh", [64, 256])
def test_mesh_and_normal_map_add_up(mesh: int, tmp_path: Path) -> None:
    """A mesh of 64 or 256 cells under a normal map of 128 texels that adds a steady slope."""
    x, _ = centers(mesh, mesh)
    heights = np.broadcast_to(0.01 * np.sin(2 * np.pi * x), (mesh, mesh))
    job = job_of(tmp_path, heights, normal=normals(np.full((128, 128), 0.1), np.full((128, 128), -0.2)))
    residual = {**job.config.model_dump(), "effects": {"mode": "auto", "normal": "residual"}}
    found = made(Job.of(GeneratorConfig.model_validate(residual), job.material))
    # The map repeats nothing of the wave, so that all of it stays.
    wave = 0.01 * 2 * np.pi * np.cos(2 * np.pi * centers(16, 16)[0])
    np.testing.assert_allclose(found.slopes[..., 0], np.broadcast_to(0.1 + wave, (16, 16)), atol=1e-3)
    np.testing.assert_allclose(found.slopes[..., 1], -0.2, atol=1e-5)


def test_reflectance_is_that_of_the_maps(tmp_path: Path) -> None:
    """Box means of maps, constants everywhere, nothing that the material lacks."""
    heights, rng = np.zeros(SQUARE), np.random.default_rng(2)
    lambert = made(job_of(tmp_path, heights, base_color=rng.random((64, 32, 3))))
    assert (lambert.roughness, lambert.metallic, lambert.specular, lambert.opacity) == (None,) * 4
    maps = {"roughness": rng.random(SQUARE), "opacity": rng.random((16, 16)).round(), "metallic": 0.25}
    color, coat = (0.1, 0.2, 0.3), {"clearcoat": maps["roughness"], "clearcoat_roughness": 0.2}
    found = made(job_of(tmp_path, heights, base_color=color, specular=0.5, **maps, **coat))
    means = maps["roughness"].reshape(16, 4, 16, 4).mean(axis=(1, 3))
    expected = {"roughness": means, "clearcoat": means, "opacity": maps["opacity"], "metallic": 0.25}
    for name, value in {**expected, "base_color": color, "specular": 0.5, "clearcoat_roughness": 0.2}.items():
        array = getattr(found, name)
        np.testing.assert_allclose(array, np.broadcast_to(value, array.shape), rtol=1e-6, err_msg=name)
    own = made(job_of(tmp_path, heights, bsdf={"type": "diffuse"}, **maps))
    assert (own.base_color, own.roughness, own.opacity) == (None,) * 3


def test_what_the_plan_leaves_out_is_left_out(tmp_path: Path) -> None:
    heights = np.broadcast_to(0.05 * np.sin(2 * np.pi * centers(64, 64)[0]), SQUARE)
    maps = {
        "normal": normals(np.full(SQUARE, 0.5), np.full(SQUARE, 0.5)),
        "opacity": np.eye(64),
        "roughness": 0.5,
        "metallic": 0.5,
        "specular": 0.5,
        "clearcoat": 0.5,
        "clearcoat_roughness": 0.1,
    }

    def of(effects: str) -> Geometry:
        return made(job_of(tmp_path, heights, effects=effects, **maps))

    wave = 0.05 * 2 * np.pi * np.cos(2 * np.pi * centers(16, 16)[0])
    bare = of("auto,-normal,-opacity,-metallic")
    np.testing.assert_allclose(bare.slopes[..., 0], np.broadcast_to(wave, (16, 16)), atol=5e-3)
    np.testing.assert_allclose(bare.slopes[..., 1], 0.0, atol=1e-6)
    assert bare.opacity is None
    assert not bare.metallic.any()
    assert of("auto,-metallic,-specular").roughness is None
    assert of("auto,-clearcoat").clearcoat is None
    # Without displacement the shading normal still follows the heights.
    plane = of("auto,-normal,-parallax")
    np.testing.assert_allclose(plane.slopes, bare.slopes, atol=1e-6)
    np.testing.assert_array_equal(plane.heights, bare.heights)


@pytest.fixture
def full(tmp_path: Path) -> Geometry:
    """Geometry of random maps, all of them."""
    rng = np.random.default_rng(3)
    maps = {name: rng.random(SQUARE) for name in (*GLOSSY, "opacity", *CLEARCOAT)}
    slopes = rng.normal(size=(2, *SQUARE))
    maps |= {"normal": normals(*slopes), "base_color": rng.random((*SQUARE, 3))}
    return made(job_of(tmp_path, 0.1 * rng.random((24, 48)), finest=2, **maps))


def test_another_reader_finds_the_channels_the_right_way_up(full: Geometry, tmp_path: Path) -> None:
    import OpenEXR

    (tmp_path / "geometry.exr").write_bytes(encode_geometry(full))
    file = OpenEXR.File(str(tmp_path / "geometry.exr"), separate_channels=True)
    parts = {part.header["name"]: {n: c.pixels for n, c in part.channels.items()} for part in file.parts}
    assert list(parts) == ["heights", "maps"]
    np.testing.assert_array_equal(parts["heights"]["height"], full.heights)
    for channel, pixels in (
        ("slope.x", full.slopes[..., 0]),
        ("slope.y", full.slopes[..., 1]),
        ("slope_moment.xy", full.slope_moments[..., 1]),
        ("slope_moment.yy", full.slope_moments[..., 2]),
        ("base_color.B", full.base_color[..., 2]),
        ("opacity", full.opacity),
    ):
        assert parts["maps"][channel].dtype == np.float32
        np.testing.assert_array_equal(parts["maps"][channel], pixels)
    assert len(parts["maps"]) == 14


def test_what_is_written_is_read(full: Geometry, tmp_path: Path) -> None:
    path = tmp_path / "geometry.exr"
    path.write_bytes(encode_geometry(full))
    assert hashlib.sha256(path.read_bytes()).hexdigest() == geometry_record(full)["sha256"]
    bare = replace(full, **dict.fromkeys((*GLOSSY, "opacity", *CLEARCOAT)), aspect=0.5 + 2**-40)
    for expected in (full, bare):
        path.write_bytes(encode_geometry(expected))
        for name, value in vars(read_geometry(path)).items():
            np.testing.assert_array_equal(value, getattr(expected, name), err_msg=name)


def _set(name: str, value: float) -> Callable[[Geometry], Geometry]:
    """One number of an array is another one."""

    def change(geometry: Geometry) -> Geometry:
        array = getattr(geometry, name).copy()
        array.flat[-1] = value
        return replace(geometry, **{name: array})

    return change


INVALID: dict[str, tuple[Callable[[Geometry], Geometry], str]] = {
    "NaN": (_set("slopes", np.nan), "'slope' holds NaN"),
    "above the plane": (_set("heights", 0.01), "maximum of 'height' is not 0"),
    "moments": (_set("slope_moments", -1.0), "negative means of squares"),
    "gloss": (lambda g: replace(g, metallic=None), "some, but not all, of roughness"),
    "aspect": (lambda g: replace(g, aspect=2.0), "8 x 4 texels, which no level has"),
}


@pytest.mark.parametrize("name", INVALID)
def test_numbers_of_no_tile_are_refused(name: str, full: Geometry, tmp_path: Path) -> None:
    change, message = INVALID[name]
    (tmp_path / "geometry.exr").write_bytes(encode_geometry(change(full)))
    with pytest.raises(InputError, match=message):
        read_geometry(tmp_path / "geometry.exr")


def test_other_files_are_refused(full: Geometry, tmp_path: Path) -> None:
    path, image = tmp_path / "geometry.exr", np.zeros((4, 8), np.float32)
    header = {"mbtf.aspect": "0.5"}
    with pytest.raises(InputError, match="no such file"):
        read_geometry(path)
    lacking = encode_parts({"heights": {"height": image}, "maps": {"slope.x": image}}, header)
    for content, message in (
        (encode_geometry(full)[:3000], "damaged or cut short"),
        (encode_parts({"heights": {"height": image}}, header), "has no parts"),
        (lacking, "no channel 'slope.y'"),
    ):
        path.write_bytes(content)
        with pytest.raises(InputError, match=message):
            read_geometry(path)


def test_a_data_set_reads_its_own_geometry(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "shards", queries={"train": "40", "test": "20"})
    heights = np.load(tmp_path / "shards.npy")
    geometry, path = data.geometry(), tmp_path / "shards" / "geometry.exr"
    np.testing.assert_array_equal(geometry.heights, (heights - heights.max()).astype(np.float32))
    again = write_dataset(tmp_path / "again", queries={"train": "60", "test": "20"}, seed=5)
    assert again.folder.read("geometry.exr") == path.read_bytes()
    flip(path, -1)
    with pytest.raises(InputError, match="has changed since it was written"):
        data.geometry()
