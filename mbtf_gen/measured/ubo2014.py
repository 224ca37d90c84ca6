"""Files ``.btf`` of the University of Bonn, compressed by a decorrelated full matrix factorization (DFMF).

The materials of UBO2014 (Weinmann, Gall and Klein 2014, "Material classification based on training data
synthesized using a BTF database") come in this format: 151 lights, 151 views, 400 x 400 texels. All numbers
are little-endian. The layout follows the readers cgbonn/btflib, by the group that made the files, and pysmtb:

- ``!DFMF08FCR``; the size in bytes of the part up to the directions (uint32, itself included); the version
  (uint32); 3 texts of 80 bytes; texels per mm and 3 scale factors of colors (float32), which none applies;
- from version 2: does the data include the cosine of the light (uint32); from version 3: the size of an XML
  text and the text; from version 4: the number of channels, and the size and text of each name;
- the number of views; of each its polar angle and azimuth in radians, the number of its lights, and theirs;
- columns and rows of the images; the number of rotations, with nine float32 each;
- the largest number of components, the color model (int32), the mean color, a 3 x 3 color matrix (row-major);
- of each channel: bytes of a number (uint8: 2, 4 or 8), the numbers of components, rows and columns (uint32);
  singular values; left vectors (rows, components); right vectors times the singular values (columns,
  components).

A row is a pair, ``view · lights + light``, and a column a texel, row-major; a file may have them the other
way round. Azimuths are taken from the images' right side to their top: the readers show texel 0 at the top
left, but no text about the format defines this.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_core.paths import opened
from mbtf_gen.measured.interface import COMPLETE, F32, I64, MOST_PAIRS, MeasuredBtf, check_texels, from_angles

MAGIC = b"!DFMF08FCR"
_TEXTS = 3 * 80
_TYPES = {2: "<f2", 4: "<f4", 8: "<f8"}
_MOST_COMPONENTS = 65_536
# Values computed at a time, and numbers of their factors; numbers that are converted as a whole.
_BLOCK, _MOST_NUMBERS, _MOST_WIDENED = 16_384, 1 << 24, 1 << 28
# Added before the logarithm; the files do not have it, the readers agree on it.
_EPSILON = 1e-5
# Rows: red, green and blue of Y, U and V; of Y, Co and Cg.
_YUV = np.array([[1.0, 0.0, 1.13983], [1.0, -0.39465, -0.5806], [1.0, 2.03211, 0.0]])
_YCOCG = np.array([[1.0, 1.0, -1.0], [1.0, 0.0, 1.0], [1.0, -1.0, -1.0]])
_MODELS = {0: "RGB", 1: "YUV", 3: "PCA", 4: "YCoCg", 9: "log Y, U, V", 11: "log Y, U/Y, V/Y", 12: "log RGB"}


@dataclass(frozen=True)
class _Header:
    """What stands before the factors."""

    cosine: bool | None
    lights: int
    light: F32
    view: F32
    rows: int
    columns: int
    model: int
    mean: NDArray[np.float64]
    matrix: NDArray[np.float64]


class _Cursor:
    """Reads a file from its start, no further than its end."""

    def __init__(self, stream: BinaryIO, path: Path) -> None:
        self.stream, self.path = stream, path
        self.size = path.stat().st_size
        self.at = 0

    def skip(self, count: int, what: str) -> None:
        """Move on; refuse files that end before."""
        if count > self.size - self.at:
            raise InputError(f"ends within {what}", where=self.path, hint=COMPLETE)
        self.at += count

    def bytes(self, count: int, what: str) -> bytes:
        at = self.at
        self.skip(count, what)
        self.stream.seek(at)
        return self.stream.read(count)

    def integer(self, what: str) -> int:
        return int.from_bytes(self.bytes(4, what), "little")

    def floats(self, count: int, what: str) -> NDArray[np.float64]:
        """Finite float32 numbers."""
        with np.errstate(invalid="ignore"):
            numbers = np.frombuffer(self.bytes(4 * count, what), "<f4").astype(np.float64)
        if not np.isfinite(numbers).all():
            raise InputError(f"has NaN or infinite numbers in {what}", where=self.path)
        return numbers


class Ubo2014(MeasuredBtf):
    """A DFMF file, opened; its factors stay on disk, and of no image more than the asked texels is
    computed."""

    at_once = 1 << 20

    def __init__(self, path: Path) -> None:
        with opened(path) as stream:
            cursor = _Cursor(stream, path)
            self._header = header = _read_header(cursor)
            self._pairs, self._texels = _map_factors(cursor, header)
        view = np.repeat(header.view, header.lights, axis=0)
        super().__init__(path, header.rows, header.columns, header.light, view)
        self.cosine = header.cosine

    def _values(self, number: I64, texel: I64) -> F32:
        channels = np.empty((len(number), 3), np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            for c, factors in enumerate(zip(self._pairs, self._texels, strict=True)):
                of_pairs, of_texels = (_widened(f, len(number)) for f in factors)
                size = max(1, min(_BLOCK, _MOST_NUMBERS // of_pairs.shape[1]))
                for start in range(0, len(number), size):
                    part = slice(start, start + size)
                    left = of_pairs[number[part]].astype(np.float32, copy=False)
                    right = of_texels[texel[part]].astype(np.float32, copy=False)
                    channels[part, c] = np.linalg.vecdot(left, right)
            out = np.empty_like(channels)
            for start in range(0, len(number), _BLOCK):
                part = slice(start, start + _BLOCK)
                out[part] = _rgb(channels[part].astype(np.float64), self._header)
        return out


def _widened(factors: NDArray[Any], values: int) -> NDArray[Any]:
    """Factors in single precision, where most rows are used several times and they fit into memory."""
    if values < 2 * len(factors) or factors.size > _MOST_WIDENED:
        return factors
    return factors.astype(np.float32)


def _read_header(cursor: _Cursor) -> _Header:
    magic = cursor.stream.read(len(MAGIC))
    if magic != MAGIC:
        kind = magic.decode("ascii", "replace")
        what = f"is a Bonn BTF of the kind '{kind}'" if magic[:1] == b"!" else "is not a Bonn BTF"
        raise InputError(what, where=cursor.path, hint=f"only '{MAGIC.decode()}' is read")
    cursor.at = len(MAGIC)
    cosine = _read_meta(cursor)
    light, view, lights = _read_directions(cursor)
    columns, rows = cursor.integer("the image size"), cursor.integer("the image size")
    check_texels(rows, columns, cursor.path)
    cursor.skip(36 * cursor.integer("the rotations"), "the rotations")
    cursor.integer("the color model")
    (model,) = struct.unpack("<i", cursor.bytes(4, "the color model"))
    if model not in _MODELS:
        known = ", ".join(f"{number} ({name})" for number, name in _MODELS.items())
        raise InputError(f"has the color model {model}", where=cursor.path, hint=f"these are read: {known}")
    mean = cursor.floats(3, "the color model")
    matrix = cursor.floats(9, "the color model").reshape(3, 3)
    return _Header(cosine, lights, light, view, rows, columns, model, mean, matrix)


def _read_meta(cursor: _Cursor) -> bool | None:
    """Do the values include the cosine?"""
    start, what = cursor.at, "the header"
    size, version = cursor.integer(what), cursor.integer(what)
    if not 1 <= version <= 4:
        raise InputError(f"has the version {version} of its header; 1 to 4 are read", where=cursor.path)
    cursor.skip(_TEXTS + 16, what)
    cosine = bool(cursor.integer(what)) if version > 1 else None
    if version > 2:
        cursor.skip(cursor.integer(what), what)
    if version > 3:
        channels = cursor.integer(what)
        if channels != 3:
            raise InputError(f"has {channels} color channels, not 3", where=cursor.path)
        for _ in range(channels):
            cursor.skip(cursor.integer(what), what)
    if cursor.at != start + size:
        raise InputError(
            f"has a header of {cursor.at - start} bytes that claims {size}", where=cursor.path, hint=COMPLETE
        )
    return cosine


def _read_directions(cursor: _Cursor) -> tuple[F32, F32, int]:
    """Lights (views * lights, 3), views (views, 3), and the number of lights of each view."""
    what = "its directions"
    views = cursor.integer(what)
    # A view takes at least 12 bytes.
    if not 1 <= views <= (cursor.size - cursor.at) // 12:
        raise InputError(f"claims {views:,} views", where=cursor.path, hint=COMPLETE)
    lights = None
    view, light = [], []
    for number in range(views):
        view.append(cursor.floats(2, what))
        count = cursor.integer(what)
        if lights is not None and count != lights:
            raise InputError(
                f"has {count:,} lights of view {number}, and {lights:,} of view 0", where=cursor.path
            )
        if not 1 <= count * views <= MOST_PAIRS:
            raise InputError(f"claims {count:,} lights and {views:,} views", where=cursor.path)
        light.append(cursor.floats(2 * count, what).reshape(count, 2))
        lights = count
    angles, tilts = np.concatenate(light), np.array(view)
    for theta in (angles[:, 0], tilts[:, 0]):
        if theta.min() < 0 or theta.max() > np.pi + 1e-3:
            raise InputError("has polar angles that are not in 0..pi radians", where=cursor.path)
    assert lights is not None
    return from_angles(angles[:, 0], angles[:, 1]), from_angles(tilts[:, 0], tilts[:, 1]), lights


def _map_factors(cursor: _Cursor, header: _Header) -> tuple[list[NDArray[Any]], list[NDArray[Any]]]:
    """Of each channel the factors of the pairs and those of the texels, on disk."""
    of_pairs, of_texels = [], []
    pairs, texels = len(header.light), header.rows * header.columns
    for channel in range(3):
        what = f"the factors of channel {channel}"
        width = cursor.bytes(1, what)[0]
        components, rows, columns = (cursor.integer(what) for _ in range(3))
        if width not in _TYPES:
            raise InputError(
                f"has numbers of {width} bytes in {what}; 2, 4 and 8 are read", where=cursor.path
            )
        if {rows, columns} != {pairs, texels}:
            raise InputError(
                f"has {rows:,} x {columns:,} factors in channel {channel},"
                f" not those of {pairs:,} pairs and {texels:,} texels",
                where=cursor.path,
            )
        if not 1 <= components <= _MOST_COMPONENTS:
            raise InputError(f"claims {components:,} components in channel {channel}", where=cursor.path)
        cursor.skip(width * components, what)
        left = _map(cursor, width, rows, components, what)
        right = _map(cursor, width, columns, components, what)
        of_pairs.append(left if rows == pairs else right)
        of_texels.append(right if rows == pairs else left)
    if cursor.at != cursor.size:
        raise InputError(f"has {cursor.size - cursor.at} bytes after its last factor", where=cursor.path)
    return of_pairs, of_texels


def _map(cursor: _Cursor, width: int, rows: int, components: int, what: str) -> NDArray[Any]:
    at = cursor.at
    cursor.skip(width * rows * components, what)
    return np.memmap(cursor.path, _TYPES[width], "r", offset=at, shape=(rows, components))


def _rgb(channels: NDArray[np.float64], header: _Header) -> NDArray[np.float64]:
    """Linear RGB (n, 3) of decorrelated channels (n, 3)."""
    model, c = header.model, channels
    if model in (9, 11, 12):
        c = c.copy()
        logs = 3 if model == 12 else 1
        c[:, :logs] = np.exp(c[:, :logs])
        if model == 11:
            c[:, 1:] *= c[:, :1]
        c[:, :logs] -= _EPSILON
    if model in (1, 9, 11):
        return c @ _YUV.T
    if model == 4:
        return c @ _YCOCG.T
    if model == 3:
        return c @ header.matrix + header.mean
    return c
