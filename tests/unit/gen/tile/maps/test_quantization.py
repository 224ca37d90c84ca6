"""Levels of integer heights: how far apart they really are, and terraces gone accordingly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.height_maps import Floats, fractal, rms, slopes

from mbtf_core.errors import InputError
from mbtf_core.images.resample import dequantize
from mbtf_gen.tile.loading import load_material
from mbtf_gen.tile.maps.checks import code_use


def stretched(truth: Floats, levels: int) -> Floats:
    """Codes of heights in [0, 1] that were rounded to so many levels and stretched to 0..255."""
    return np.rint(np.rint(truth * (levels - 1)) * 255 / (levels - 1))


@pytest.mark.parametrize("levels", [40, 60, 115, 132, 200])
def test_stretched_histograms(levels: int) -> None:
    use = code_use(stretched(fractal(256, 256, 1.5), levels))
    assert use.spacing == pytest.approx(255 / (levels - 1), rel=2e-3)
    assert use.rounding == pytest.approx(np.hypot(255 / (levels - 1), 1), rel=2e-3)


def test_gaps_of_rare_or_irregular_codes_are_no_stretch() -> None:
    """Few texels at the ends leave gaps in the histogram by chance."""
    rng = np.random.default_rng(0)
    assert code_use(np.rint(np.clip(rng.normal(128, 20, (200, 200)), 0, 255))).spacing == 1.0
    rng = np.random.default_rng(2)
    assert code_use(rng.choice(rng.choice(256, 80, replace=False), (64, 64))).spacing == 1.0


@pytest.mark.parametrize("values", [[0, 255], [0, 100, 200], list(range(0, 150, 10))])
def test_terraces_that_are_meant_stay(values: list[int]) -> None:
    codes = np.random.default_rng(1).choice(values, (64, 64))
    assert code_use(codes).spacing == 1.0


@pytest.mark.parametrize("exponent", [1.0, 1.5, 2.0, 2.5, 3.0])
def test_detail_is_never_worse_than_stored(exponent: float) -> None:
    """From rough maps, where nothing can be gained, to smooth ones."""
    truth = fractal(256, 256, exponent)
    stored = np.rint(truth * 255) / 255
    out = dequantize(stored, 1 / 255)
    assert rms(out - truth) < 1.01 * rms(stored - truth)
    assert rms(slopes(out) - slopes(truth)) < 1.01 * rms(slopes(stored) - slopes(truth))


@pytest.mark.parametrize("levels", [60, 115, 200])
@pytest.mark.parametrize("exponent", [2.5, 3.0])
def test_terraces_of_stretched_heights_vanish(levels: int, exponent: float) -> None:
    truth = fractal(256, 256, exponent)
    codes = stretched(truth, levels)
    out = dequantize(codes / 255, code_use(codes).rounding / 255)
    by_one = dequantize(codes / 255, 1 / 255)
    assert rms(slopes(out) - slopes(truth)) < 0.3 * rms(slopes(codes / 255) - slopes(truth))
    assert rms(slopes(out) - slopes(truth)) < 0.5 * rms(slopes(by_one) - slopes(truth))
    assert rms(out - truth) < 0.6 * rms(codes / 255 - truth)


class TestMaterial:
    def test_stretched(self, tmp_path: Path) -> None:
        codes = stretched(fractal(128, 128, 2.5), 115)
        Image.fromarray(codes.astype(np.uint8)).save(tmp_path / "height.png")
        material = load_material(tmp_path)
        assert "115 distinct values 2.237 codes apart" in material.warnings[0]
        moved = np.abs(material.height - codes / 255).max() * 255
        assert 0.6 < moved <= 0.5 * np.hypot(255 / 114, 1) * (1 + 1e-3)

    def test_eight_bits_in_a_sixteen_bit_file(self, tmp_path: Path) -> None:
        codes = np.rint(fractal(128, 128) * 255) * 257
        Image.fromarray(codes.astype(np.uint16)).save(tmp_path / "height.png")
        material = load_material(tmp_path)
        assert "257 codes apart" in material.warnings[0]
        assert np.abs(material.height * 65535 - codes).max() <= 128.5 + 1e-6
        assert len(np.unique(material.height)) > 1000


def test_large_maps_of_small_files_are_not_smoothed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Smoothing takes 60 bytes per pixel: a file of kilobytes would take gigabytes."""
    monkeypatch.setattr("mbtf_gen.tile.assembly._SMOOTHED", 1 << 12)
    path = tmp_path / "h.png"
    Image.fromarray(np.repeat(np.arange(128, dtype=np.uint8)[:, None] // 64, 128, axis=1)).save(path)
    assert path.stat().st_size * 64 < 128**2
    with pytest.raises(InputError, match="almost all"):
        load_material(path)
    (tmp_path / "material.yaml").write_text("height: {file: h.png, dequantize: false}\n")
    assert load_material(tmp_path).height.shape == (128, 128)
