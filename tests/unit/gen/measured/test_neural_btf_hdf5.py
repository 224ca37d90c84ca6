"""Captures of NeuralBTF: the known function, round trip, and files that are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import measured_files as files
from support.fuzzing import damaged, examples, loads_or_refuses

from mbtf_core.errors import InputError
from mbtf_gen.measured.neural_btf_hdf5 import read_neural_btf, write_neural_btf

TEXELS = files.ROWS * files.COLUMNS


def pairs() -> tuple[np.ndarray, np.ndarray]:
    """Nine lights and views above the horizon, as float32."""
    light, view = files.unit(files.LIGHTS), files.unit(files.VIEWS[:3])
    return np.tile(light, (3, 1)).astype(np.float32), np.repeat(view, 3, axis=0).astype(np.float32)


def stored() -> dict[str, np.ndarray]:
    """A file of the known function whose third light is at the horizon."""
    light, view = pairs()
    color = np.array([files.image(i, o) for i, o in zip(light, view, strict=True)], np.float32)
    light[2, :2] = [1, 0]
    return {"ground_light": light[:, :2], "ground_camera_dir": view[:, :2], "ground_color": color}


def test_the_known_function(tmp_path: Path) -> None:
    btf = read_neural_btf(files.write_hdf5(tmp_path / "a.hdf5", stored()))
    assert (btf.rows, btf.columns, btf.left_out, btf.cosine) == (files.ROWS, files.COLUMNS, 1, None)
    assert len(btf.light) == 8
    order = np.random.default_rng(2).permutation(8 * TEXELS)
    pair, texel = order // TEXELS, order % TEXELS
    row, column = np.divmod(texel, files.COLUMNS)
    light, view = btf.light[pair].astype(np.float64), btf.view[pair].astype(np.float64)
    np.testing.assert_allclose(btf.values(pair, texel), files.value(row, column, light, view), rtol=1e-5)
    # A few texels of the last rows of one image.
    at = (files.ROWS - 2) * files.COLUMNS + np.array([1, 6])
    np.testing.assert_array_equal(
        btf.values(np.array([3, 3]), at), stored()["ground_color"][4].reshape(-1, 3)[at]
    )


def test_round_trip(tmp_path: Path) -> None:
    light, view = pairs()
    images = np.random.default_rng(0).gamma(0.3, 2.0, (9, 6, 5, 3)).astype(np.float32)
    path = tmp_path / "a.hdf5"
    write_neural_btf(path, light, view, iter(images))
    btf = read_neural_btf(path)
    np.testing.assert_array_equal(btf.light[:, :2], light[:, :2])
    np.testing.assert_allclose(btf.light, light, atol=1e-6)
    np.testing.assert_array_equal(btf.view[:, :2], view[:, :2])
    np.testing.assert_allclose(btf.view, view, atol=1e-6)
    pair, texel = np.divmod(np.arange(9 * 30), 30)
    np.testing.assert_array_equal(btf.values(pair, texel).reshape(images.shape), images)
    with h5py.File(path) as file:
        shapes = {name: (file[name].shape, file[name].dtype) for name in file}
    assert shapes == {
        "ground_light": ((9, 2), np.float32),
        "ground_camera_dir": ((9, 2), np.float32),
        "ground_color": ((9, 6, 5, 3), np.float32),
    }


def test_what_cannot_be_written(tmp_path: Path) -> None:
    light, view = pairs()
    image = np.zeros((6, 5, 3), np.float32)
    low = light * np.float32([1, 1, -1])
    cases: list[tuple[Any, Any, list[np.ndarray], str]] = [
        (light, view, [image] * 8, "8 images of 9 pairs"),
        (light, view, [image] * 10, "one too many"),
        (light, view, [image, image[:5]], "differs in shape"),
        (light, view, [image * np.nan], "not finite"),
        (low, view, [image] * 9, "above the horizon"),
        (light, view[:8], [image] * 9, "ground_camera_dir"),
    ]
    for lights, views, images, message in cases:
        with pytest.raises(InputError, match=message):
            write_neural_btf(tmp_path / "a.hdf5", lights, views, images)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "array", "message"),
    [
        ("ground_light", None, "no data set 'ground_light'"),
        ("ground_light", np.zeros((8, 2)), "the shape"),
        ("ground_camera_dir", np.zeros((9, files.ROWS, files.COLUMNS, 2)), "direction for each pixel"),
        ("ground_camera_dir", np.full((9, 2), np.nan), "unit vectors"),
        ("ground_camera_dir", np.full((9, 2), 0.8), "unit vectors"),
        ("ground_light", np.ones((9, 2)) * [1, 0], None),
        ("ground_color", np.zeros((9, 5, 4, 4)), "the shape"),
        ("ground_color", np.zeros((9, 5, 4, 3), np.uint8), "floats are expected"),
    ],
)
def test_refused(name: str, array: Any, message: str | None, tmp_path: Path) -> None:
    arrays = {key: a for key, a in (stored() | {name: array}).items() if a is not None}
    path = files.write_hdf5(tmp_path / "a.hdf5", arrays)
    if message is None:
        assert read_neural_btf(path).left_out == 9
        return
    with pytest.raises(InputError) as caught:
        read_neural_btf(path)
    assert message in caught.value.message


def test_nan_values_are_refused_where_they_are_used(tmp_path: Path) -> None:
    arrays = stored()
    arrays["ground_color"][0, 1, 1, 1] = np.nan
    btf = read_neural_btf(files.write_hdf5(tmp_path / "a.hdf5", arrays))
    btf.values(np.array([0]), np.array([0]))
    with pytest.raises(InputError, match="NaN or infinite"):
        btf.values(np.array([0, 0]), np.array([0, files.COLUMNS + 1]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("neural")


@given(data=st.data())
@examples(200)
def test_a_damaged_file(data: st.DataObject, folder: Path) -> None:
    path = folder / "a.hdf5"
    if not path.exists():
        files.write_hdf5(path, stored())
    _, content = data.draw(damaged({"a": path.read_bytes()}))
    (folder / "damaged.hdf5").write_bytes(content)
    btf = loads_or_refuses(lambda: read_neural_btf(folder / "damaged.hdf5"))
    if btf is not None and len(btf.light):
        texels = np.arange(min(btf.rows * btf.columns, 50))
        values = loads_or_refuses(lambda: btf.values(np.zeros_like(texels), texels))
        assert values is None or np.isfinite(values).all()
