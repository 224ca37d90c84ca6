"""At any distance, mean and contrast of a fitted material are those of filtered pixels."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from support.plugin_materials import write_material
from support.plugin_scenes import plane, sensor_of, through_pixel_centers
from support.scenes import directional, mi

from mbtf_core.directions import from_angles
from mbtf_core.pictures import Camera

FINEST = 6
LIGHT = from_angles(60.0, 20.0)


def filtered(
    values: NDArray[np.float64], sigma: float, rows: int, longer: float = 1.0, azimuth: float = 0.0
) -> NDArray[np.float64]:
    """A periodic texture (n, n), row 0 at the top, behind a Gaussian of `sigma` tile widths, and of so many
    times as much along an azimuth (degrees), at rows x rows texel centers."""
    n = len(values)
    frequency = np.fft.fftfreq(n, 1.0 / n)
    angle = np.radians(azimuth)
    along = np.cos(angle) * frequency - np.sin(angle) * frequency[:, None]
    square = frequency[:, None] ** 2 + frequency**2 + (longer**2 - 1.0) * along**2
    passed = np.exp(-2.0 * (np.pi * sigma) ** 2 * square)
    # The center of a coarse texel lies between fine ones.
    shift = np.exp(1j * np.pi * frequency * (1.0 / rows - 1.0 / n))
    spectrum = np.fft.fft2(values) * passed * shift[:, None] * shift
    return np.asarray(np.fft.ifft2(spectrum).real[:: n // rows, :: n // rows], np.float64)


@pytest.fixture(scope="module")
def texture() -> NDArray[np.float64]:
    """Small positive values of every wavelength down to a texel of the finest level."""
    random = np.random.default_rng(2)
    values = sum(
        np.kron(random.random((2**s, 2**s)), np.ones((2 ** (FINEST - s),) * 2)) for s in range(1, FINEST + 1)
    )
    return 0.05 * np.kron(np.asarray(values), np.ones((4, 4))) / FINEST


@pytest.fixture(scope="module")
def material(texture: NDArray[np.float64], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its first feature goes through the decoder, whose exp(x) - 1 is x + x²/2."""
    weights: dict[str, torch.Tensor] = {"unit": torch.ones(())}
    for s in range(FINEST + 1):
        level = np.zeros((2**s, 2**s, 7), np.float32)
        # The tent between texels, whose variance is a sixth of their square, is two thirds of the footprint.
        level[..., 0] = filtered(texture, 0.5 * 2.0**-s / 3**0.5, 2**s)
        weights[f"pyramid.{s}"] = torch.from_numpy(level)
    for layer, (outputs, inputs) in enumerate(((25, 11), (25, 25), (25, 25), (3, 25))):
        weight = torch.zeros(outputs, inputs)
        weight[: 3 if layer == 3 else 1, 0] = 1.0
        weights |= {f"decoder.{layer}.weight": weight, f"decoder.{layer}.bias": torch.zeros(outputs)}
    folder = tmp_path_factory.mktemp("material")
    write_material(folder, model="neumip-baseline", finest=FINEST, weights=weights)
    return folder


def seen(
    material: Path, camera: Camera, samples: int = 1, **options: Any
) -> tuple[NDArray[np.float64], Callable[[NDArray[np.float64]], NDArray[np.float64]]]:
    """What ``mbtf_path`` sees of a plane, and a function that reads a texture at its pixels."""
    bsdf: Any = {"type": "mbtf", "material": str(material), "sampling": "cosine", "networks": "cooperative"}
    mesh = plane(bsdf, half=2.0 * camera.tiles_across + 2.0)
    parts = {"m": mesh, "e": directional(LIGHT), "sensor": sensor_of(camera)}
    scene = mi.load_dict({"type": "scene", **parts})
    integrator = mi.load_dict({"type": "mbtf_path", "max_depth": 2, **options})
    u = camera.queries(LIGHT).u

    def at_pixels(texture: NDArray[np.float64]) -> NDArray[np.float64]:
        rows = len(texture)
        row, column = (np.minimum((x * rows).astype(int), rows - 1) for x in (1.0 - u[..., 1], u[..., 0]))
        return texture[row, column]

    return through_pixel_centers(scene, camera, integrator, samples)[..., 0], at_pixels


@pytest.mark.parametrize("tiles_across", [0.25, 3.0, 30.0, 300.0])
def test_pixels_are_filtered(material: Path, texture: NDArray[np.float64], tiles_across: float) -> None:
    camera = Camera(
        80.0, -70.0, tiles_across=tiles_across, target=(0.3, 0.6), rows=64, columns=64, field_of_view=6.0
    )
    found, at_pixels = seen(material, camera, max_anisotropy=1)
    sigma = float(np.median(camera.queries(LIGHT).sigma))
    wanted = np.expm1(at_pixels(filtered(texture, max(sigma, 0.5 * 2.0**-FINEST), len(texture))))
    assert found.mean() == pytest.approx(wanted.mean(), rel=0.01)
    # Between two coarse levels a blend is no Gaussian, which little contrast shows.
    assert found.std() == pytest.approx(wanted.std(), rel=0.12, abs=0.025 * wanted.mean())


def test_footprints_of_grazing_pixels_are_elongated(material: Path, texture: NDArray[np.float64]) -> None:
    """A pixel at 15° covers 3.9 times as much along the view as across it."""
    elevation, azimuth = 15.0, -50.0
    # The minor radius, half of a pixel's width, is that of level 5.
    camera = Camera(
        elevation, azimuth, tiles_across=1.0, target=(0.3, 0.6), rows=32, columns=32, field_of_view=2.0
    )
    longer = 1.0 / np.sin(np.radians(elevation))

    def compared(most: float, ratio: float) -> tuple[float, float]:
        """Contrast over that of the filtered texture, and the RMS difference over its contrast."""
        found, at_pixels = seen(material, camera, 256, max_anisotropy=most)
        minor = camera.tiles_across / 64 * longer / ratio
        wanted = np.expm1(at_pixels(filtered(texture, minor, len(texture), ratio, azimuth)))
        difference = np.sqrt(np.mean((found - wanted) ** 2))
        return found.std() / wanted.std(), difference / wanted.std()

    contrast, difference = compared(16.0, longer)
    assert contrast == pytest.approx(1.0, abs=0.04)
    assert difference < 0.15
    # A bound of 2 widens the minor radius; levels are interpolated.
    contrast, difference = compared(2.0, 2.0)
    assert contrast == pytest.approx(1.0, abs=0.08)
    assert difference < 0.15


def test_other_surfaces_are_not_filtered(material: Path) -> None:
    """A checkerboard at 10° beside a material looks as it does with round footprints."""
    camera = Camera(10.0, -60.0, tiles_across=1.0, rows=16, columns=16, field_of_view=2.0)
    board = {"type": "diffuse", "reflectance": {"type": "checkerboard"}}
    bsdf: Any = {"type": "mbtf", "material": str(material), "sampling": "cosine", "networks": "cooperative"}
    other = mi.ScalarTransform4f().translate([0.0, 0.0, -1.0])
    parts = {"m": plane(board), "n": {"type": "rectangle", "to_world": other, "b": bsdf}}
    scene = mi.load_dict({"type": "scene", **parts, "e": directional(LIGHT), "sensor": sensor_of(camera)})
    elongated, round_ = (
        through_pixel_centers(scene, camera, mi.load_dict({"type": "mbtf_path", "max_depth": 2, **options}))
        for options in ({}, {"max_anisotropy": 1})
    )
    assert len(np.unique(round_)) > 1
    np.testing.assert_array_equal(elongated, round_)
