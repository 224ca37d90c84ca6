"""Maps whose numbers leave [0, 1]: by lossy compression, by wide primaries, or because they are wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.image_files import exr, rng

from mbtf_core.errors import InputError
from mbtf_gen.tile.loading import load_material

ACESCG = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    np.save(tmp_path / "height.npy", 0.1 * rng().random((32, 32)))
    return tmp_path


def stripes(low: float = 0.0, high: float = 1.0) -> np.ndarray:
    return np.where(np.arange(32 * 32).reshape(32, 32) // 3 % 2, high, low).astype(np.float16)


@pytest.mark.parametrize("compression", ["DWAA", "DWAB"])
def test_lossy_exr_is_clamped_with_one_warning(folder: Path, compression: str) -> None:
    import OpenEXR

    head = {"compression": getattr(OpenEXR, f"{compression}_COMPRESSION")}
    rough = exr(folder / "rough.exr", {"Y": stripes()}, **head)
    exr(folder / "diff.exr", {name: stripes(0.0, 0.02) for name in "RGB"}, **head)
    (stored,) = OpenEXR.File(str(rough), separate_channels=True).parts[0].channels.values()
    outside = (stored.pixels > 1) | (stored.pixels < 0)
    assert outside.any()
    material = load_material(folder)
    assert material.maps["roughness"] == pytest.approx(np.clip(stored.pixels, 0, 1))
    assert material.maps["base_color"].min() >= 0
    (warning,) = (w for w in material.warnings if "rough.exr" in w)
    assert f"{outside.sum()} pixels" in warning
    assert f"{float(np.max(stored.pixels)) - 1:.2g}" in warning
    assert compression in warning


@pytest.mark.parametrize(
    ("compression", "dtype", "number", "read"),
    [
        ("ZIP", np.float16, 1 + 2**-10, True),
        ("ZIP", np.float16, 1 + 2**-9, False),
        ("NO", np.float32, -0.01, False),
        ("PXR24", np.float32, 1 + 2**-15, True),
        ("B44", np.float16, -1e-5, True),
        ("B44", np.float16, 1.01, False),
        ("DWAA", np.float16, 1.5, False),
    ],
)
def test_the_tolerance_depends_on_the_compression(
    folder: Path, compression: str, dtype: type, number: float, read: bool
) -> None:
    import OpenEXR

    numbers = np.full((32, 32), number, dtype)
    exr(folder / "rough.exr", {"Y": numbers}, compression=getattr(OpenEXR, f"{compression}_COMPRESSION"))
    if read:
        material = load_material(folder)
        assert np.all(material.maps["roughness"] == np.clip(number, 0, 1))
        assert any("1024 pixels" in w and "clamped" in w for w in material.warnings)
    else:
        with pytest.raises(InputError, match=r"1024 pixels.* outside") as caught:
            load_material(folder)
        assert "clamp" in caught.value.hint


def test_primaries_matter_for_colors_only(folder: Path) -> None:
    numbers = rng().uniform(0.3, 0.6, (32, 32)).astype(np.float32)
    exr(folder / "diff.exr", {"R": 2 * numbers - 0.2, "G": numbers, "B": numbers}, chromaticities=ACESCG)
    exr(folder / "rough.exr", {"Y": numbers}, chromaticities=ACESCG)
    material = load_material(folder)
    assert np.array_equal(material.maps["roughness"], numbers.astype(float))
    # Red by the published matrix, 1.70505 R - 0.62179 G - 0.08326 B, clamped.
    red = 1.70505 * (2 * numbers - 0.2) - 0.70505 * numbers
    assert material.maps["base_color"][..., 0] == pytest.approx(np.clip(red, 0, 1), abs=1e-4)
    (warning,) = material.warnings
    assert f"{int((red > 1.001).sum())} pixels" in warning
    assert "ACEScg" in warning
    assert "ACEScg" in material.facts["base_color"].colorspace
