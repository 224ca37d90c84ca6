"""Data sets of NeuMIP: conventions, round trip, and files that are refused."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.fuzzing import damaged, examples, loads_or_refuses
from support.measured_files import write_hdf5

from mbtf_core.errors import InputError
from mbtf_gen.measured.neumip_hdf5 import read_neumip, write_neumip

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
    data = read_neumip(write_hdf5(tmp_path / "a.hdf5", stored(), base_radius=1 / 64))
    assert (data.count, data.base_radius) == (24, 1 / 64)
    # Query 17 is image 1, row 1, column 1; the range begins and ends within images.
    queries = data.read(7, 20)
    i = 17 - 7
    assert queries["query"].tolist() == list(range(7, 20))
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


def test_a_flat_file_with_the_other_name(tmp_path: Path) -> None:
    arrays = stored((24,), np.float32)
    arrays["ground_light_dir"] = arrays.pop("ground_light")
    flat = read_neumip(write_hdf5(tmp_path / "a.hdf5", arrays)).read(5, 9)
    images = read_neumip(write_hdf5(tmp_path / "b.hdf5", stored())).read(5, 9)
    for name in ("query", *FIELDS):
        np.testing.assert_array_equal(flat[name], images[name])


def test_positions_wrap_and_a_radius_of_zero_is_a_texel(tmp_path: Path) -> None:
    arrays = stored()
    arrays["ground_camera_target_loc"][0, 0, 0] = [1.0, -1.25]
    arrays["ground_camera_query_radius"][:] = 0
    queries = read_neumip(write_hdf5(tmp_path / "a.hdf5", arrays)).read(0, 1)
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
    queries = read_neumip(write_hdf5(tmp_path / "a.hdf5", arrays)).read(0, 9)
    assert queries["query"].tolist() == [0, 7, 8]
    assert {len(queries[name]) for name in FIELDS} == {3}


def ours(count: int, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    out = {
        "u": rng.random((count, 2), np.float32),
        "sigma": (2.0 ** -rng.uniform(1, 9, count)).astype(np.float32),
    }
    for name in ("omega_i", "omega_o"):
        xyz = rng.normal(size=(count, 3))
        xyz[:, 2] = np.abs(xyz[:, 2]) + 0.05
        out[name] = (xyz / np.linalg.norm(xyz, axis=1, keepdims=True)).astype(np.float32)
    out["value"] = rng.gamma(0.3, 2.0, (count, 3)).astype(np.float32)
    out["value"][0] = [0, 1e-40, 3e38]
    return out


def batches(queries: dict[str, np.ndarray], sizes: tuple[int, ...]) -> Iterator[dict[str, np.ndarray]]:
    at = 0
    for size in sizes:
        yield {name: array[at : at + size] for name, array in queries.items()}
        at += size


def test_round_trip(tmp_path: Path) -> None:
    queries = ours(64)
    path = tmp_path / "a.hdf5"
    assert write_neumip(path, batches(queries, (3, 20, 0, 40, 1)), 128, (4, 8)) == 64
    data = read_neumip(path)
    assert (data.count, data.base_radius) == (64, 0.5 / 128)
    again = data.read(0, data.count)
    np.testing.assert_array_equal(again["value"], queries["value"])
    np.testing.assert_array_equal(again["sigma"], queries["sigma"])
    distance = np.abs(again["u"] - queries["u"])
    assert np.minimum(distance, 1 - distance).max() < 1e-7
    for name in ("omega_i", "omega_o"):
        np.testing.assert_array_equal(again[name][:, :2], queries[name][:, :2])
        np.testing.assert_allclose(again[name], queries[name], atol=2e-6)


def test_the_written_shapes(tmp_path: Path) -> None:
    assert write_neumip(tmp_path / "a.hdf5", batches(ours(70), (70,)), 128, (4, 8)) == 64
    with h5py.File(tmp_path / "a.hdf5") as file:
        shapes = {name: file[name].shape for name in file}
        assert file.attrs["base_radius"] == 0.5 / 128
    assert shapes == {
        "ground_color": (2, 4, 8, 3),
        "ground_camera_target_loc": (2, 4, 8, 2),
        "ground_camera_query_radius": (2, 4, 8, 1),
        "ground_camera_dir": (2, 4, 8, 2),
        "ground_light": (2, 4, 8, 2),
    }


@pytest.mark.parametrize("name", FIELDS)
def test_invalid_queries_are_not_written(name: str, tmp_path: Path) -> None:
    queries = ours(32)
    queries[name][3] = np.nan
    with pytest.raises(InputError, match=name):
        write_neumip(tmp_path / "a.hdf5", [queries], 128, (4, 8))
    with pytest.raises(InputError, match="do not fill an image"):
        write_neumip(tmp_path / "a.hdf5", [ours(31)], 128, (4, 8))
    assert list(tmp_path.iterdir()) == []


def changed(**new: Any) -> dict[str, Any]:
    return {name: array for name, array in (stored() | new).items() if array is not None}


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (changed(ground_light=None), "no data set 'ground_light'"),
        (changed(ground_color=None), "no data set 'ground_color'"),
        (changed(ground_light=np.zeros((2, 3, 4, 3))), "the shape"),
        (changed(ground_camera_query_radius=np.zeros((2, 3, 5, 1))), "the shape"),
        (changed(ground_color=np.zeros((2, 3, 4, 3), np.int32)), "floats are expected"),
        (changed(ground_color=np.zeros(3)), "the shape"),
        (changed(ground_color=np.zeros((0, 3, 4, 3))), "the shape"),
        (changed(ground_valid=np.ones((2, 3, 4, 1))), "rendering of a scene"),
    ],
)
def test_refused(arrays: dict[str, np.ndarray], message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        read_neumip(write_hdf5(tmp_path / "a.hdf5", arrays))


@pytest.mark.parametrize("radius", [-1.0, np.nan, "x", [1.0, 2.0]])
def test_base_radius_is_a_positive_number(radius: Any, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="base_radius"):
        read_neumip(write_hdf5(tmp_path / "a.hdf5", stored(), base_radius=radius))


def test_numbers_that_are_not_in_the_file(tmp_path: Path) -> None:
    path = write_hdf5(tmp_path / "a.hdf5", changed(ground_color=None))
    elsewhere = write_hdf5(tmp_path / "b.hdf5", stored())
    shape = (2, 3, 4, 3)
    with h5py.File(path, "r+") as file:
        file["ground_color"] = h5py.ExternalLink(elsewhere.name, "ground_color")
    with pytest.raises(InputError, match="link in place"):
        read_neumip(path)
    with h5py.File(path, "r+") as file:
        del file["ground_color"]
        file.create_dataset("ground_color", shape, "f4", external=[(str(elsewhere), 0, 288)])
    with pytest.raises(InputError, match="in other files"):
        read_neumip(path)
    with h5py.File(path, "r+") as file:
        del file["ground_color"]
        file.create_dataset("ground_color", shape, "f4")
    with pytest.raises(InputError, match="stores 0 of the 288 bytes"):
        read_neumip(path)
    with h5py.File(path, "r+") as file:
        del file["ground_color"]
        file.create_dataset("ground_color", shape, "f4", chunks=(1, 3, 4, 3))[0] = 1
    with pytest.raises(InputError, match="stores 1 of the 2 chunks"):
        read_neumip(path)
    with h5py.File(path, "r+") as file:
        del file["ground_color"]
        file.create_dataset("ground_color", (10**9, 3, 4, 3), "f4", chunks=(10**7, 3, 4, 3))
    with pytest.raises(InputError, match="too large"):
        read_neumip(path)
    with pytest.raises(InputError, match="no such file"):
        read_neumip(tmp_path / "c.hdf5")
    (tmp_path / "d.hdf5").write_bytes(elsewhere.read_bytes()[:-100])
    with pytest.raises(InputError, match="cannot be read as HDF5"):
        read_neumip(tmp_path / "d.hdf5")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("neumip")


@pytest.fixture(scope="module")
def samples(folder: Path) -> dict[str, bytes]:
    plain = write_hdf5(folder / "plain.hdf5", stored(), base_radius=0.1)
    write_neumip(folder / "chunks.hdf5", [ours(64)], 128, (4, 8))
    return {"plain": plain.read_bytes(), "chunks": (folder / "chunks.hdf5").read_bytes()}


@given(data=st.data())
@examples(300)
def test_a_damaged_file(data: st.DataObject, samples: dict[str, bytes], folder: Path) -> None:
    _, content = data.draw(damaged(samples))
    path = folder / "damaged.hdf5"
    path.write_bytes(content)
    found = loads_or_refuses(lambda: read_neumip(path))
    if found is not None:
        queries = loads_or_refuses(lambda: found.read(0, 30))
        if queries is not None:
            assert all(np.isfinite(queries[name]).all() for name in FIELDS)
            assert ((queries["u"] >= 0) & (queries["u"] < 1)).all()
