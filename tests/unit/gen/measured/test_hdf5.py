"""HDF5 of NeuMIP: conventions, and files that are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from support.measured_files import write_hdf5

from mbtf_core.errors import InputError
from mbtf_gen.measured.hdf5 import NeumipQueries

FIELDS = ("u", "sigma", "omega_i", "omega_o", "value")


def stored(shape: tuple[int, ...] = (2, 3, 4), dtype: Any = np.float16) -> dict[str, np.ndarray]:
    """Arrays of a file whose numbers are all known."""
    n = np.arange(np.prod(shape)).reshape(shape)
    two = np.stack([n, n], axis=-1)
    return {
        "ground_color": (np.stack([n, n + 100, n + 200], axis=-1) / 8).astype(dtype),
        "ground_camera_target_loc": (two * [1 / 32, -1 / 64] + [-0.5, 0.75]).astype(dtype),
        "ground_camera_query_radius": ((n[..., None] + 1) / 64).astype(dtype),
        "ground_camera_dir": (two * [1 / 64, -1 / 128] + [0.125, 0.25]).astype(dtype),
        "ground_light": (two * [-1 / 64, 1 / 128] + [0.0, -0.5]).astype(dtype),
    }


def test_conventions(tmp_path: Path) -> None:
    data = NeumipQueries(write_hdf5(tmp_path / "a.hdf5", stored(), base_radius=1 / 64))
    assert (data.count, data.base_radius) == (24, 1 / 64)
    # Query 17 is image 1, row 1, column 1; the range begins and ends within images.
    queries = data.read(7, 20)
    i = 17 - 7
    assert len(queries["u"]) == 20 - 7
    x, y = 17 / 32 - 0.5, 0.75 - 17 / 64
    np.testing.assert_array_equal(queries["u"][i], [(x + 1) / 2, (y + 1) / 2])
    assert queries["sigma"][i] == 18 / 64
    # Towards the light and the viewer: against the stored directions, which go down.
    np.testing.assert_allclose(queries["omega_i"][i, :2], [17 / 64, 0.5 - 17 / 128])
    np.testing.assert_allclose(queries["omega_o"][i, :2], [-17 / 64 - 0.125, 17 / 128 - 0.25])
    for omega in (queries["omega_i"], queries["omega_o"]):
        np.testing.assert_allclose(np.linalg.norm(omega, axis=1), 1, atol=1e-6)
        assert omega[:, 2].min() > 0
    np.testing.assert_array_equal(queries["value"][i], [17 / 8, 117 / 8, 217 / 8])
    assert all(queries[name].dtype == np.float32 for name in FIELDS)


def test_positions_wrap_and_a_radius_of_zero_is_a_texel(tmp_path: Path) -> None:
    """The light may have its other name."""
    arrays = stored()
    arrays["ground_light_dir"] = arrays.pop("ground_light")
    arrays["ground_camera_target_loc"][0, 0, 0] = [1.0, -1.25]
    arrays["ground_camera_query_radius"][:] = 0
    queries = NeumipQueries(write_hdf5(tmp_path / "a.hdf5", arrays)).read(0, 1)
    np.testing.assert_array_equal(queries["u"], [[0, 0.875]])
    assert queries["sigma"].tolist() == [0.5 / 4]


def test_unusable_queries_are_left_out(tmp_path: Path) -> None:
    arrays = stored()
    arrays["ground_color"][0, 0, 1, 2] = np.nan
    arrays["ground_color"][0, 0, 2, 0] = np.inf
    arrays["ground_light"][0, 0, 3] = [0.8, 0.7]
    arrays["ground_camera_dir"][0, 1, 0] = [1, 0]
    arrays["ground_camera_query_radius"][0, 1, 1] = -1
    arrays["ground_camera_target_loc"][0, 1, 2, 0] = np.nan
    queries = NeumipQueries(write_hdf5(tmp_path / "a.hdf5", arrays)).read(0, 9)
    assert (8 * queries["value"][:, 0]).tolist() == [0, 7, 8]
    assert {len(queries[name]) for name in FIELDS} == {3}


def changed(**new: Any) -> dict[str, Any]:
    return {name: array for name, array in (stored() | new).items() if array is not None}


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (changed(ground_light=None), "no data set 'ground_light'"),
        (changed(ground_camera_query_radius=np.zeros((2, 3, 5, 1))), "the shape"),
        (changed(ground_color=np.zeros((2, 3, 4, 3), np.int32)), "floats are expected"),
        (changed(ground_color=np.zeros((0, 3, 4, 3))), "the shape"),
        (changed(ground_valid=np.ones((2, 3, 4, 1))), "rendering of a scene"),
    ],
)
def test_refused(arrays: dict[str, np.ndarray], message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        NeumipQueries(write_hdf5(tmp_path / "a.hdf5", arrays))


def color(file: h5py.File, shape: tuple[int, ...] = (2, 3, 4, 3), **options: Any) -> h5py.Dataset:
    return file.create_dataset("ground_color", shape, "f4", **options)


def test_numbers_that_are_not_in_the_file(tmp_path: Path) -> None:
    path = write_hdf5(tmp_path / "a.hdf5", changed(ground_color=None))
    elsewhere = write_hdf5(tmp_path / "b.hdf5", stored())
    link = h5py.ExternalLink(elsewhere.name, "ground_color")
    huge = {"chunks": (10**7, 3, 4, 3), "maxshape": (None, 3, 4, 3)}
    for change, message in (
        (lambda file: file.update(ground_color=link), "of its own"),
        (lambda file: color(file, external=[(str(elsewhere), 0, 288)]), "of its own"),
        (lambda file: color(file), "stores 0 of the 288 bytes"),
        (lambda file: color(file, (10, 3, 4, 3), **huge), "too large"),
    ):
        with h5py.File(path, "r+") as file:
            change(file)
        with pytest.raises(InputError, match=message):
            NeumipQueries(path)
        with h5py.File(path, "r+") as file:
            del file["ground_color"]
    (tmp_path / "d.hdf5").write_bytes(elsewhere.read_bytes()[:-100])
    with pytest.raises(InputError, match="cannot be read as HDF5"):
        NeumipQueries(tmp_path / "d.hdf5")


def test_numbers_that_a_file_cannot_have(tmp_path: Path) -> None:
    path = tmp_path / "a.hdf5"
    with h5py.File(path, "w") as file:
        shape = (30, 512, 512, 3)
        color = file.create_dataset("ground_color", shape, np.float32, chunks=shape, compression="gzip")
        color[...] = 0.0
    with pytest.raises(InputError, match="claims 94,371,840 bytes"):
        NeumipQueries(path)
