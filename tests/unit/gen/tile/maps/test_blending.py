"""Blended maps tile, and along their seams they look as they do inside."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.height_maps import Floats, fractal, normals_of, slopes

from mbtf_core.data.lattice import texel_centers
from mbtf_core.images.resample import resample
from mbtf_gen.tile.maps.tiling import BAND, blend_maps, broken, seams


def blend(role: str, image: Floats) -> Floats:
    out: Floats = blend_maps({role: image})[role]
    return out


def stationary(seed: int, feature: float = 0.03) -> Floats:
    """A random texture (160, 192) of one feature size, cut from a larger tile, so that it does not tile."""
    rows, columns = 240, 288
    noise = np.fft.rfft2(np.random.default_rng(seed).normal(size=(rows, columns)))
    f = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(columns)) * 192 * feature
    out = np.fft.irfft2(noise * np.exp(-f * f), (rows, columns))
    return out[:160, :192] / out.std()


def bands(shape: tuple[int, ...]) -> tuple[Any, Any]:
    """Texels of the blended bands, and of the interior."""
    v, u = (np.minimum(x, 1 - x) < BAND for x in ((np.arange(n) + 0.5) / n for n in shape[:2]))
    near = v[:, None] | u[None, :]
    return near, ~near


def ratios(images: list[Floats]) -> tuple[float, float]:
    """Variance and mean squared gradient along the seams over those inside, of several textures together."""
    near, inside = bands(images[0].shape)
    gradients = [(slopes(f) ** 2).sum(axis=0) for f in images]
    variances = [(f - f.mean()) ** 2 for f in images]
    return tuple(  # type: ignore[return-value]
        float(np.mean([x[near].mean() for x in maps]) / np.mean([x[inside].mean() for x in maps]))
        for maps in (variances, gradients)
    )


class TestStatistics:
    def test_heights_keep_variance_and_gradient(self) -> None:
        """A plain cross-fade has 0.72 of both, half of it where bands cross."""
        found = ratios([blend("height", stationary(seed)) for seed in range(6)])
        assert found == pytest.approx((1.0, 1.0), abs=0.05)

    def test_colors_keep_their_histogram(self) -> None:
        """Skewed values: sums of two are not distributed as one of them, a plain cross-fade's least so."""
        before = [np.exp(stationary(seed)) for seed in range(8)]
        after = [blend("base_color", np.stack([f, 2 * f, f * f], -1))[..., 0] for f in before]
        near, _ = bands(before[0].shape)
        at = (0.02, 0.1, 0.5, 0.9, 0.98)
        old = np.quantile([f[near] for f in before], at)
        assert np.quantile([f[near] for f in after], at) == pytest.approx(old, rel=0.05)
        assert min(f.min() for f in after) >= min(f.min() for f in before)
        assert max(f.max() for f in after) <= max(f.max() for f in before)

    def test_repeated_structures_continue(self) -> None:
        """Stripes whose period does not divide the tile stay stripes of nearly that period (28.1 texels)."""
        u = texel_centers(16, 256)[..., 0]
        found = blend("height", np.sin(2 * np.pi * 9.1 * u))
        assert np.abs(found).max() == pytest.approx(1.0, abs=0.03)
        crests = (found[0] > np.roll(found[0], 1)) & (found[0] >= np.roll(found[0], -1)) & (found[0] > 0.9)
        gaps = np.diff(np.flatnonzero(crests), append=np.flatnonzero(crests)[0] + 256)
        assert crests.sum() == 9
        assert gaps.min() >= 26
        assert gaps.max() <= 33


@pytest.mark.parametrize("shape", [(96, 96), (61, 83)])
def test_seams_close(shape: tuple[int, int]) -> None:
    height = fractal(128, 128)[: shape[0], : shape[1]]
    assert any(broken(s) for s in seams(height))
    assert not any(broken(s) for s in seams(blend("height", height)))


def test_maps_of_all_resolutions_are_shifted_alike() -> None:
    """The same function of uv at two resolutions, one of them odd, stays the same function."""

    def wave(n: int) -> Floats:
        uv = texel_centers(n, n)
        return np.sin(2 * np.pi * 0.7 * uv[..., 0] + 0.3) * np.cos(2 * np.pi * 0.6 * uv[..., 1])

    both = blend_maps({"height": wave(63), "metallic": wave(63), "roughness": wave(63 * 5)})
    assert np.abs(resample(both["roughness"], 63, 63) - both["metallic"]).max() < 0.05
    assert np.abs(blend("height", wave(63 * 5))[2::5, 2::5] - both["height"]).max() < 0.03


def test_normals_have_the_slopes_of_the_blended_heights() -> None:
    height = stationary(1)
    out = blend_maps({"height": height, "normal": normals_of(height, 0.004)})
    expected = normals_of(out["height"], 0.004)
    # The slope of the weights themselves is the mesh's, and normals are cut at the seams of the first maps.
    inner = (slice(2, -2), slice(2, -2))
    assert np.linalg.norm(out["normal"], axis=-1) == pytest.approx(1.0, abs=1e-6)
    error = np.abs(out["normal"] - expected)[inner]
    assert np.sqrt(np.mean(error**2)) < 0.12 * np.sqrt(np.mean(expected[..., :2] ** 2))
