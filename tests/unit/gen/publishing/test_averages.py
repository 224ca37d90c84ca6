"""Pictures of averages show what the function behind the values shows, the right way round."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.fit_data import write_data
from support.published import LAYOUTS, small

from mbtf_core.data.dataset import Dataset
from mbtf_gen.publishing.averages import ELEVATIONS, LIGHTS, Averages, averages, brdf_bins, tile_shape
from mbtf_gen.publishing.pictures import displayed, picture_makers
from mbtf_gen.publishing.statistics import split_statistics


def quadrants(u, sigma, omega_i, omega_o):  # type: ignore[no-untyped-def]
    """Red is a sine of u, green one of v; blue is the cosine between light and view, from 0 to 2."""
    blue = 1.0 + (omega_i * omega_o).sum(axis=-1)
    red, green = 1.0 + 0.5 * np.sin(2 * np.pi * u.T)
    return np.stack([red, green, blue], axis=-1) + 0.0 * sigma[:, None]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> tuple[Dataset, Averages]:
    folder = tmp_path_factory.mktemp("averages") / "data"
    write_data(folder, quadrants, train=60_000, test=10, finest=4)
    data = Dataset.open(folder)
    return data, averages(data)


def test_the_tile_has_row_0_at_the_top(found: tuple[Dataset, Averages]) -> None:
    _, mean = found
    everything = mean.tile[0]
    rows, columns = everything.shape[:2]
    assert min(rows, columns) >= 4
    u = (np.arange(columns) + 0.5) / columns
    v = 1.0 - (np.arange(rows) + 0.5) / rows
    red, green = (1.0 + 0.5 * np.sin(2 * np.pi * x) for x in (u, v))
    np.testing.assert_allclose(everything[..., 0], np.broadcast_to(red, (rows, columns)), atol=0.1)
    np.testing.assert_allclose(everything[..., 1], np.broadcast_to(green[:, None], (rows, columns)), atol=0.1)


def test_the_brdf_has_the_light_on_the_right(found: tuple[Dataset, Averages]) -> None:
    data, mean = found
    bins = brdf_bins(data)
    axis = (np.arange(bins) + 0.5) / bins * 2 - 1
    x, y = axis[None, :], -axis[:, None]
    inside = np.hypot(x, y) < 0.9
    z = np.sqrt(np.maximum(0.0, 1 - x**2 - y**2))
    for picture, (low, high) in zip(mean.brdf, ELEVATIONS, strict=True):
        bright = picture[..., 2]
        known = inside & np.isfinite(bright)
        assert known.sum() > 0.8 * inside.sum()
        middle = np.radians(0.5 * (max(low, 12.0) + high))
        expected = 1 + np.cos(middle) * x + np.sin(middle) * z
        assert np.corrcoef(bright[known], np.broadcast_to(expected, bright.shape)[known])[0, 1] > 0.95
        # The mean over the tile of what varies with the position alone.
        assert np.abs(picture[..., 0][known].mean() - 1.0) < 0.02


def test_lights_come_from_their_sides(tmp_path: Path) -> None:
    def lit(u, sigma, omega_i, omega_o):  # type: ignore[no-untyped-def]
        return np.stack([omega_i[:, 0], omega_i[:, 1], omega_i[:, 2]], axis=-1) + 1.0

    write_data(tmp_path / "data", lit, train=20_000, test=10, finest=2)
    mean = dict(
        zip(LIGHTS, np.nanmean(averages(Dataset.open(tmp_path / "data")).tile - 1, axis=(1, 2)), strict=True)
    )
    assert mean["light from the left"][0] < -0.3
    assert mean["light from the right"][0] > 0.3
    assert mean["light from the top"][1] > 0.3
    assert np.abs(mean["all lights"][:2]).max() < 0.05


def test_pictures_are_as_fine_as_their_queries(found: tuple[Dataset, Averages]) -> None:
    data, _ = found
    rows, columns = tile_shape(data)
    assert 60_000 / (rows * columns) >= 64
    assert columns == 16


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_has_its_pictures(layout: str, tmp_path: Path, draws: None) -> None:
    data = small(tmp_path / "data", layout)
    makers = picture_makers(data, lambda: {s: split_statistics(data, s) for s in data.splits})
    assert list(makers) == ["tile.png", "brdf.png", "values.png", "queries.png", "surface.png"]
    for name in ("tile.png", "brdf.png", "values.png", "surface.png"):
        first = makers[name](tmp_path / name)
        assert makers[name](tmp_path / f"again-{name}").sha256 == first.sha256
        pixels = np.asarray(Image.open(tmp_path / name).convert("L"), np.float64)
        assert pixels.std() > 5, name


def test_bright_is_bright_and_unknown_is_gray() -> None:
    picture = np.full((1, 3, 3), 0.02)
    picture[0, 1] = (0.04, 0.02, 0.01)
    picture[0, 2] = np.nan
    shown = displayed(picture).astype(int)[0]
    assert shown[1, 0] > shown[0, 0] > shown[1, 2] > 20
    assert shown[2].tolist() == [238, 238, 238]


def test_few_queries_are_averaged_with_their_neighbors(tmp_path: Path) -> None:
    """Means of noise without neighbors would scatter by 1/√n of the queries of a pixel."""

    def noise(u, sigma, omega_i, omega_o):  # type: ignore[no-untyped-def]
        return 1.0 + np.random.default_rng(len(u)).standard_normal((len(u), 1)) * np.ones(3)

    write_data(tmp_path / "data", noise, train=20_000, test=10, finest=4)
    tile = averages(Dataset.open(tmp_path / "data")).tile
    for picture in tile:
        assert np.isfinite(picture).all()
        assert picture[..., 0].std() < 1.5 / np.sqrt(48)
