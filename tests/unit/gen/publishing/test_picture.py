"""The picture of a card shows what the function behind the values shows, the right way round."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.fit_data import constant, write_data
from support.published import LAYOUTS, small

from mbtf_core.data.dataset import Dataset
from mbtf_gen.publishing.picture import tile_image, write_picture


def test_the_tile_has_u_and_v_where_they_belong(tmp_path: Path) -> None:
    """Red is a sine of u, green one of v."""

    def value(u, sigma, omega_i, omega_o):  # type: ignore[no-untyped-def]
        red, green = 1.0 + 0.5 * np.sin(2 * np.pi * u.T)
        return np.stack([red, green, np.ones_like(red)], axis=-1)

    write_data(tmp_path / "data", value, train=60_000, test=10, finest=4)
    arrays = Dataset.open(tmp_path / "data").load("train")
    tile = tile_image(arrays, 1.0)
    at = (np.arange(len(tile)) + 0.5) / len(tile)
    wave = np.broadcast_to(1.0 + 0.5 * np.sin(2 * np.pi * at), tile.shape[:2])
    np.testing.assert_allclose(tile[..., 0], wave, atol=0.1)
    np.testing.assert_allclose(tile[..., 1], wave[:, ::-1].T, atol=0.1)


def test_highlights_that_few_queries_see_are_no_specks(tmp_path: Path) -> None:
    """A query in 500 is a thousand times as bright: a mean of 32 queries would exceed white by far."""
    write_data(tmp_path / "data", constant(0.1), train=20_000, test=10, finest=4)
    arrays = Dataset.open(tmp_path / "data").load("train")
    for key in ("value_a", "value_b"):
        arrays[key] = np.where(np.arange(20_000)[:, None] % 500 == 0, 100.0, arrays[key])
    assert np.nanmax(tile_image(arrays, 1.0)) < 0.16


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_has_its_picture(layout: str, tmp_path: Path, draws: None) -> None:
    data = small(tmp_path / "data", layout)
    shown = data.load("train"), data.lattice.aspect, data.geometry()
    first = write_picture(*shown, tmp_path / "a.png")
    assert write_picture(*shown, tmp_path / "b.png").sha256 == first.sha256
    assert np.asarray(Image.open(tmp_path / "a.png").convert("L"), np.float64).std() > 5
