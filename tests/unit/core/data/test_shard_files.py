"""Shards on disk: both formats, both layouts, any reader, and every kind of damage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from mbtf_core.data.schema import ARRAYS
from mbtf_core.data.shard_files import check_arrays, read_npz, read_shard, write_shard
from mbtf_core.errors import InputError

SHUFFLED = (2500,)
IMAGE = (3, 4, 8)
FORMATS = ("npz", "exr")


def arrays(lead: tuple[int, ...], holes: bool = False) -> dict[str, NDArray[np.float32]]:
    """Arrays of a shard, every number different, with values from 1e-8 to 1e5."""
    rng = np.random.default_rng(5)
    out = {}
    for spec in ARRAYS:
        if spec.name != "transmittance" or holes:
            numbers = 10.0 ** rng.uniform(-8, 5, (*lead, *spec.trailing)) * rng.choice(
                [-1, 1], lead + spec.trailing
            )
            out[spec.name] = numbers.astype(np.float32)
    return out


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("lead", [SHUFFLED, IMAGE, (1,), (1024,), (1, 1, 1), (2, 5, 3), (5, 9), (7, 1)])
@pytest.mark.parametrize("holes", [False, True])
def test_arrays_round_trip(tmp_path: Path, suffix: str, lead: tuple[int, ...], holes: bool) -> None:
    path = tmp_path / f"train-00000.{suffix}"
    written = arrays(lead, holes)
    write_shard(path, written)
    back = read_shard(path)
    assert list(back) == list(written)
    for name, array in written.items():
        assert back[name].dtype == np.float32
        assert np.array_equal(back[name], array), name
    assert check_arrays(back, path) == lead


def test_npz_is_read_by_numpy_itself(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    written = arrays(IMAGE)
    write_shard(path, written)
    with np.load(path) as archive:
        assert set(archive.files) == set(written)
        for name, array in written.items():
            assert np.array_equal(archive[name], array)
    np.savez(path, **written)  # type: ignore[arg-type]
    assert np.array_equal(read_shard(path)["u"], written["u"])


def test_npz_is_mapped_and_aligned(tmp_path: Path) -> None:
    """Mapped arrays are views of the file: no copy, read-only, at offsets that suit any vector unit."""
    path = tmp_path / "x.npz"
    write_shard(path, arrays(SHUFFLED, holes=True))
    for array in read_npz(path).values():
        assert isinstance(array, np.memmap)
        assert array.offset % 64 == 0
        assert not array.flags.writeable
    assert not any(isinstance(a, np.memmap) for a in read_npz(path, mapped=False).values())


def test_bytes_depend_on_the_arrays_alone(tmp_path: Path) -> None:
    first, second = tmp_path / "a.npz", tmp_path / "b.npz"
    content = arrays(SHUFFLED)
    write_shard(first, content)
    write_shard(second, dict(reversed(content.items())))
    assert first.read_bytes() == second.read_bytes()


def test_exr_has_named_float_channels_of_the_right_place(tmp_path: Path) -> None:
    """Shuffled queries lie row by row, images one below the other; any EXR reader finds them by name."""
    import OpenEXR

    flat, stacked = tmp_path / "flat.exr", tmp_path / "stacked.exr"
    queries, images = arrays(SHUFFLED), arrays(IMAGE)
    write_shard(flat, queries)
    write_shard(stacked, images)
    with OpenEXR.File(str(flat), separate_channels=True) as file:
        assert set(file.channels()) == {c for a in ARRAYS if a.name != "transmittance" for c in a.channels}
        image = file.channels()["omega_i.z"].pixels
        assert image.dtype == np.float32
        assert image.shape == (3, 1024)
        assert image[2, 100] == queries["omega_i"][2 * 1024 + 100, 2]
    with OpenEXR.File(str(stacked), separate_channels=True) as file:
        image = file.channels()["value_a.G"].pixels
        assert image.shape == (3 * 4, 8)
        assert image[2 * 4 + 1, 5] == images["value_a"][2, 1, 5, 1]


def test_arrays_that_do_not_belong_together_are_refused() -> None:
    good = arrays(SHUFFLED)
    for name, array, message in (
        ("extra", np.zeros(2500, np.float32), "unknown array 'extra'"),
        ("sigma", np.zeros(2499, np.float32), r"'sigma' has the shape \(2499,\)"),
    ):
        with pytest.raises(InputError, match=message):
            check_arrays({**good, name: array}, "x.npz")


@pytest.mark.parametrize("suffix", FORMATS)
def test_unreadable_files_are_refused(tmp_path: Path, suffix: str, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / f"x.{suffix}"
    with pytest.raises(InputError, match="no such shard"):
        read_shard(path)
    write_shard(path, arrays(SHUFFLED))
    whole = path.read_bytes()
    for share in (0.001, 0.1, 0.5, 0.99):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InputError):
            read_shard(path)
    assert capfd.readouterr() == ("", "")


def test_an_npz_array_that_claims_more_than_it_holds_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    write_shard(path, arrays(SHUFFLED))
    path.write_bytes(path.read_bytes().replace(b"(2500,", b"(9500,"))
    with pytest.raises(InputError, match="not as long as its header says"):
        read_shard(path)


def test_an_exr_image_that_is_no_shard(tmp_path: Path) -> None:
    import OpenEXR

    path = tmp_path / "x.exr"
    header = {"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"Y": np.zeros((4, 4), np.float32)}).write(str(path))
    with pytest.raises(InputError, match="not a shard"):
        read_shard(path)
