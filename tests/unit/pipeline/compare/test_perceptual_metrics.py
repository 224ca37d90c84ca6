"""FLIP, SSIM and ST-LPIPS against closed forms, the definition and the published network."""

from __future__ import annotations

import sys
import types

import numpy as np
import pytest

from mbtf_core.color import to_display
from mbtf_pipeline.compare.perceptual_metrics import flip, ssim, st_lpips, to_srgb, weights_file

F64 = np.ndarray
needs_weights = pytest.mark.skipif(
    weights_file() is None, reason="no ST-LPIPS weights; to enable: pip install 'mbtf[perceptual]'"
)


def pair(shape: tuple[int, int] = (40, 33)) -> tuple[F64, F64]:
    """A linear image and its reference, both within [0, 1]."""
    random = np.random.default_rng(2)
    reference = random.random((*shape, 3))
    return np.clip(reference + 0.2 * random.standard_normal(reference.shape), 0, 1), reference


def test_srgb_matches_the_display_conversion() -> None:
    values = np.linspace(-0.1, 0.4, 300).reshape(10, 10, 3).astype(np.float32)
    np.testing.assert_array_equal(np.round(255 * to_srgb(values, 0.25)), to_display(values, 2.0))


def test_only_the_ratio_to_white_matters_and_values_above_are_clipped() -> None:
    picture, reference = pair()
    assert ssim(7 * picture, 7 * reference, 7.0) == pytest.approx(ssim(picture, reference, 1.0))
    assert ssim(2 + picture, 2 + reference, 1.0) == pytest.approx(1.0)
    # None if a side is shorter than the window.
    assert ssim(picture[:10], reference[:10], 1.0) is None


def test_ssim_is_that_of_another_implementation() -> None:
    metrics = pytest.importorskip("skimage.metrics")
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    pictures = [to_srgb(image, 1.0) for image in pair()]
    expected = metrics.structural_similarity(*pictures, data_range=1.0, channel_axis=-1, **options)
    assert ssim(*pair(), 1.0) == pytest.approx(expected, rel=1e-12)


@pytest.fixture
def published(monkeypatch: pytest.MonkeyPatch) -> object:
    """The package's own network, with stubs for unused imports."""
    names = ("IPython", "torchvision", "torchvision.models", "torchsummary")
    modules = {name: types.ModuleType(name) for name in names}
    vars(modules["IPython"])["embed"] = None
    vars(modules["torchvision"])["models"] = modules["torchvision.models"]
    vars(modules["torchsummary"])["summary"] = None
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    for name in [n for n in sys.modules if n.startswith("stlpips_pytorch")]:
        monkeypatch.delitem(sys.modules, name)
    from stlpips_pytorch import stlpips

    return stlpips.LPIPS(net="alex", variant="shift_tolerant", verbose=False)


@needs_weights
@pytest.mark.parametrize("shape", [(32, 32), (57, 40)])
def test_st_lpips_matches_the_published_network(published: object, shape: tuple[int, int]) -> None:
    import torch

    assert callable(published)
    pictures = pair(shape)
    srgb = ((2 * to_srgb(p, 1.0) - 1).astype(np.float32) for p in pictures)
    with torch.no_grad():
        expected = float(published(*(torch.from_numpy(x.transpose(2, 0, 1)[None]) for x in srgb)))
    assert st_lpips(*pictures, 1.0) == pytest.approx(expected, rel=1e-5)


@needs_weights
def test_st_lpips_of_equal_and_of_small_images() -> None:
    picture, reference = pair()
    assert st_lpips(reference, reference, 1.0) == 0.0
    expected = pytest.approx(st_lpips(5 * picture, 5 * reference, 5.0), rel=1e-5)
    assert st_lpips(picture, reference, 1.0) == expected
    assert st_lpips(picture[:20], reference[:20], 1.0) is None


# A reference with a bright half, and a fit that differs only there: 4 or 5 times white.
REFERENCE, FIT = (np.repeat(np.array([0.05, bright], np.float32), 16) for bright in (0.8, 1.0))
REFERENCE, FIT = (np.broadcast_to(row[:, None], (24, 32, 3)) for row in (REFERENCE, FIT))


def test_only_hdr_flip_responds_above_white() -> None:
    assert flip(REFERENCE, REFERENCE, 0.2)[:2] == (0, 0)
    ldr, hdr, hdr_map = flip(FIT, REFERENCE, 0.2)
    assert ldr < 1e-6
    assert hdr > 0.01
    assert hdr_map.shape == (24, 32)
    assert hdr_map[:, 22:].mean() > 10 * hdr_map[:, :10].mean()
    assert hdr == pytest.approx(float(hdr_map.mean()), rel=1e-3)


def test_only_the_ratio_to_white_matters_to_flip() -> None:
    assert flip(7 * FIT, 7 * REFERENCE, 1.4)[1] == pytest.approx(flip(FIT, REFERENCE, 0.2)[1], rel=1e-4)
    assert flip(FIT, REFERENCE, 2.0)[0] > 0.01
