"""Small measured BTFs of a known function, written from the formats' descriptions."""

from __future__ import annotations

import io
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

ROWS, COLUMNS = 5, 4
# Polar angles and azimuths in degrees; the last view is below the horizon.
LIGHTS = [(0, 0), (30, 20), (60, 130)]
VIEWS = [(15, 300), (45, 60), (75, 200), (95, 10)]
_YUV = np.array([[1.0, 0.0, 1.13983], [1.0, -0.39465, -0.5806], [1.0, 2.03211, 0.0]])
_YCOCG = np.array([[1.0, 1.0, -1.0], [1.0, 0.0, 1.0], [1.0, -1.0, -1.0]])
PCA_MATRIX = np.array([[0.5, 0.4, 0.1], [-0.3, 0.2, 0.6], [0.2, -0.7, 0.3]])
PCA_MEAN = np.array([0.02, 0.05, 0.01])


def unit(angles: Any) -> F64:
    """Unit vectors (n, 3) of polar angles and azimuths in degrees."""
    theta, phi = np.deg2rad(np.atleast_2d(np.asarray(angles, np.float64))).T
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


def value(row: Any, column: Any, light: F64, view: F64) -> F64:
    """The known function (n, 3): no symmetry of light and view, rows and columns, or channels."""
    row, column = np.asarray(row, np.float64), np.asarray(column, np.float64)
    base = np.stack([0.1 + 0.1 * row / ROWS, 0.2 + 0.05 * column, 0.05 + 0.01 * row + 0.02 * column], axis=-1)
    slope = 1.0 + 0.5 * light[..., 0] + 0.2 * light[..., 1] - 0.1 * view[..., 0] + 0.3 * view[..., 1]
    return base * (slope + 0.1 * light[..., 0] * view[..., 1])[..., None]


def image(light: F64, view: F64) -> F64:
    """The image (rows, columns, 3) of one light and one view."""
    row, column = np.mgrid[:ROWS, :COLUMNS]
    return value(row, column, light, view)


def grid() -> F64:
    """Values (views, lights, rows, columns, 3)."""
    return np.array([[image(li, vi) for li in unit(LIGHTS)] for vi in unit(VIEWS)])


def decorrelated(rgb: F64, model: int) -> F64:
    """Channels that a color model makes of linear RGB."""
    if model == 0:
        return rgb
    if model == 3:
        return (rgb - PCA_MEAN) @ np.linalg.inv(PCA_MATRIX)
    if model == 4:
        return rgb @ np.linalg.inv(_YCOCG).T
    if model == 12:
        return np.log(rgb + 1e-5)
    yuv = rgb @ np.linalg.inv(_YUV).T
    out = yuv.copy()
    if model in (9, 11):
        out[..., 0] = np.log(yuv[..., 0] + 1e-5)
    if model == 11:
        out[..., 1:] = yuv[..., 1:] / (yuv[..., :1] + 1e-5)
    return out


def btf(
    model: int = 0,
    width: int = 4,
    transposed: bool = False,
    version: int = 4,
    cosine: int = 1,
    rotations: int = 1,
) -> bytes:
    """A DFMF file of the known function."""
    # Channels have numbers of components of their own.
    used = (12, 11, 11)
    return factorized(grid(), LIGHTS, VIEWS, model, width, transposed, version, cosine, rotations, used)


def factorized(
    values: F64,
    lights: Any,
    views: Any,
    model: int = 0,
    width: int = 4,
    transposed: bool = False,
    version: int = 4,
    cosine: int = 1,
    rotations: int = 0,
    components: tuple[int, int, int] | None = None,
) -> bytes:
    """A DFMF file of values (views, lights, rows, columns, 3) at polar angles and azimuths in degrees."""
    count, each, height, across = values.shape[:4]
    meta = b"a dome".ljust(80, b"\0") + b"a sensor".ljust(80, b"\0") + b"a lamp".ljust(80, b"\0")
    meta += struct.pack("<4f", 10.0, 2.0, 3.0, 4.0)
    if version > 1:
        meta += struct.pack("<I", cosine)
    if version > 2:
        meta += struct.pack("<I", 6) + b"<xml/>"
    if version > 3:
        meta += struct.pack("<I", 3) + b"".join(struct.pack("<I", 1) + c for c in (b"R", b"G", b"B"))
    out = b"!DFMF08FCR" + struct.pack("<II", 8 + len(meta), version) + meta
    out += struct.pack("<I", count)
    for angles in views:
        out += np.deg2rad(angles).astype("<f4").tobytes() + struct.pack("<I", each)
        out += np.deg2rad(lights).astype("<f4").tobytes()
    out += struct.pack("<II", across, height)
    out += struct.pack("<I", rotations) + rotations * np.eye(3, dtype="<f4").tobytes()
    matrices = decorrelated(values, model).reshape(count * each, height * across, 3)
    most = min(matrices.shape[:2])
    out += struct.pack("<Ii", most, model) + PCA_MEAN.astype("<f4").tobytes()
    out += PCA_MATRIX.astype("<f4").tobytes()
    for channel in range(3):
        matrix = matrices[..., channel].T if transposed else matrices[..., channel]
        u, s, v = np.linalg.svd(matrix, full_matrices=False)
        used = most if components is None else components[channel]
        kind = f"<f{width}"
        out += struct.pack("<BIII", width, used, *matrix.shape)
        out += s[:used].astype(kind).tobytes() + u[:, :used].astype(kind).tobytes()
        out += (v.T * s)[:, :used].astype(kind).tobytes()
    return out


def encoded(light: F64, view: F64, kind: str = "JPEG", rows: int = 16, columns: int = 24) -> bytes:
    """An image file: four flat quarters of 8-bit sRGB, so that JPEG keeps them."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(codes(light, view, rows, columns)).save(stream, kind, quality=100, subsampling=0)
    return stream.getvalue()


def codes(light: F64, view: F64, rows: int = 16, columns: int = 24) -> NDArray[np.uint8]:
    """8-bit codes (rows, columns, 3) of four quarters with the known function of (0 or 2, 0 or 2)."""
    row, column = np.mgrid[:rows, :columns]
    linear = value(2 * (row >= rows // 2), 2 * (column >= columns // 2), light, view)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    out: NDArray[np.uint8] = np.rint(255 * srgb).astype(np.uint8)
    return out


def photographs() -> dict[str, bytes]:
    """Name → content of the images of all lights and views, named as in the database of 2003."""
    out = {}
    for (tv, pv), vi in zip(VIEWS, unit(VIEWS), strict=True):
        for number, ((tl, pl), li) in enumerate(zip(LIGHTS, unit(LIGHTS), strict=True)):
            name = f"{number:05} tl{tl:03} pl{pl:03} tv{tv:03} pv{pv:03}.jpg"
            out[f"tv{tv:03}_pv{pv:03}/{name}"] = encoded(li, vi)
    return out


def write_folder(folder: Path, files: dict[str, bytes]) -> Path:
    """A folder of these files."""
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder


def zipped(files: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    """A zip archive of these files."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return stream.getvalue()


def write_hdf5(path: Path, arrays: dict[str, NDArray[Any]], **attributes: Any) -> Path:
    """An HDF5 file of these data sets."""
    import h5py

    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file[name] = array
        file.attrs.update(attributes)
    return path
