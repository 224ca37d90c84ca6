"""Photographs whose names are the directions, in a folder or a zip archive: UBO2003 and its relatives.

The BTF Database Bonn of 2003 (Sattler, Sarlette and Klein 2003, "Efficient and realistic visualization of
cloth") has 81 lights and 81 views, 256 x 256 texels, as archives of JPEG images. Each name has four angles in
degrees: ``00001 tl000 pl000 tv000 pv000.jpg`` has the light's polar angle and azimuth, then the viewer's. The
separators, the order and the folders vary (UTIA: ``tv000_pv000/tl000_pl000_tv000_pv000.png``); the four
letters do not. The readers btf-extractor and btf-rendering, and UTIA's description, agree on this. The
archives ATRIUM of Bonn name HDR photographs in the same way.

Nothing says these three: codes of 8 or 16 bits are taken as sRGB, floats as linear; azimuths run from the
images' right side to their top; and whether the values include the cosine of the light is left open (plain
photographs do).
"""

from __future__ import annotations

import io
import re
import tempfile
import warnings as python_warnings
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.color import srgb_to_linear
from mbtf_core.errors import InputError, reason
from mbtf_core.images.environment import read_linear
from mbtf_core.paths import opened, real_path
from mbtf_gen.measured.interface import COMPLETE, F32, I64, MeasuredBtf, check_texels, from_angles

SUFFIXES = (".jpg", ".jpeg", ".png", ".exr", ".hdr")
_ANGLES = tuple(
    re.compile(rf"(?<![a-z]){letters}(\d{{1,3}}(?:\.\d+)?)") for letters in ("tl", "pl", "tv", "pv")
)
_EXAMPLE = "a name has the angles of the light and the viewer: tl015 pl060 tv030 pv090.jpg"
_MOST_FILES = 200_000
# Largest file of an image, and the largest ratio to its compressed size in an archive.
_MOST_BYTES = 1 << 28
_MOST_RATIO = 100
# Where a PNG file has its bits per channel.
_PNG_BITS = 24
# Linear values of the codes.
_LINEAR = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)

Content = Callable[[str], bytes]


class Ubo2003(MeasuredBtf):
    """Photographs in a folder, which may have sub-folders, or in a zip archive. Nothing is unpacked to
    disk."""

    def __init__(self, path: Path) -> None:
        self.path = path
        names = _files_in(path) if path.is_dir() else _members_of(path)
        table: dict[tuple[float, float, float, float], str] = {}
        for name in names:
            angles = angles_of(name)
            if angles is None:
                continue
            if max(angles[0], angles[2]) > 180 or max(angles[1], angles[3]) > 720:
                raise InputError(f"'{_short(name)}' has angles out of range", where=path)
            if angles in table:
                raise InputError(
                    f"has two images of the same directions: '{_short(table[angles])}' and '{_short(name)}'",
                    where=path,
                    hint="keep one of them",
                )
            table[angles] = name
        if not table:
            raise _without_photographs(names, path)
        self._names = [table[angles] for angles in sorted(table)]
        radians = np.deg2rad(sorted(table))
        light, view = from_angles(radians[:, 0], radians[:, 1]), from_angles(radians[:, 2], radians[:, 3])
        super().__init__(path, 0, 0, light, view)
        if not len(self._number):
            raise InputError("has no image with light and view above the horizon", where=path)
        with self._opened() as content:
            self.rows, self.columns = self._decoded(content, int(self._number[0])).shape[:2]

    def _values(self, number: I64, texel: I64) -> F32:
        out = np.empty((len(number), 3), np.float32)
        order = np.argsort(number, kind="stable")
        used, starts = np.unique(number[order], return_index=True)
        with self._opened() as content:
            for image, group in zip(used, np.split(order, starts[1:]), strict=True):
                out[group] = self._texels(content, int(image), *np.divmod(texel[group], self.columns))
        return out

    @contextmanager
    def _opened(self) -> Iterator[Content]:
        """A function that returns the content of an image by its name."""
        if self.path.is_dir():
            yield lambda name: _read_file(self.path / name)
        else:
            with _archive(self.path) as archive:
                yield lambda name: _read_member(archive, name, self.path)

    def _texels(self, content: Content, number: int, row: I64, column: I64) -> F32:
        """Values (n, 3) of an image at rows and columns (n,)."""
        pixels = self._decoded(content, number)
        if pixels.shape[:2] != (self.rows, self.columns):
            raise InputError(
                f"'{_short(self._names[number])}' has {pixels.shape[1]} x {pixels.shape[0]} texels,"
                f" other images {self.columns} x {self.rows}",
                where=self.path,
            )
        found = pixels[row, column]
        return _LINEAR[found] if found.dtype == np.uint8 else found.astype(np.float32)

    def _decoded(self, content: Content, number: int) -> NDArray[Any]:
        """An image (H, W, 3): 8-bit sRGB codes, or linear floats; gray becomes RGB."""
        name = self._names[number]
        data = content(name)
        try:
            pixels = _codes(data) if _is_8_bit(name, data) else _floats(name, data)
            check_texels(pixels.shape[0], pixels.shape[1], self.path)
        except InputError as error:
            raise InputError(f"'{_short(name)}' {error.what}", where=self.path, hint=error.hint) from None
        except Exception as error:  # a damaged file may make the decoder raise anything
            what = f"'{_short(name)}' cannot be decoded ({reason(error)})"
            raise InputError(what, where=self.path, hint=COMPLETE) from None
        return pixels


def _is_8_bit(name: str, data: bytes) -> bool:
    suffix = PurePosixPath(name.lower()).suffix
    return suffix.startswith(".jp") or (suffix == ".png" and data[_PNG_BITS : _PNG_BITS + 1] != b"\x10")


def _codes(data: bytes) -> NDArray[np.uint8]:
    from PIL import Image as Pillow

    with python_warnings.catch_warnings():
        python_warnings.simplefilter("ignore")
        with Pillow.open(io.BytesIO(data), formats=["JPEG", "PNG"]) as picture:
            check_texels(picture.height, picture.width, Path())
            if picture.mode not in ("RGB", "L"):
                raise InputError(f"has the pixel mode '{picture.mode}'", hint="save it as gray or RGB")
            return np.asarray(picture.convert("RGB"))


def _floats(name: str, data: bytes) -> NDArray[np.float64]:
    # The library for EXR reads files only.
    with tempfile.TemporaryDirectory(prefix="mbtf-") as folder:
        path = Path(folder, "image").with_suffix(PurePosixPath(name).suffix)
        path.write_bytes(data)
        return np.asarray(read_linear(path), np.float64)


def angles_of(name: str) -> tuple[float, float, float, float] | None:
    """Polar angle and azimuth of the light, then of the viewer, in degrees; None of other names."""
    stem = name.replace("\\", "/").rsplit("/", 1)[-1].lower()
    found = [pattern.findall(stem) for pattern in _ANGLES]
    if not stem.endswith(SUFFIXES) or any(len(numbers) != 1 for numbers in found):
        return None
    tl, pl, tv, pv = (float(numbers[0]) for numbers in found)
    return tl, pl, tv, pv


def _short(name: str) -> str:
    return name if len(name) <= 80 else f"...{name[-77:]}"


def _without_photographs(names: Sequence[str], path: Path) -> InputError:
    """What is wrong with files of which none is a photograph named by its directions."""
    what = "has no images that are named by their directions"
    what += f", but files such as '{_short(names[0])}'" if names else ""
    return InputError(what, where=path, hint=f"{', '.join(SUFFIXES)} are read; {_EXAMPLE}")


def _files_in(path: Path) -> list[str]:
    """All files of a folder; links that lead out of it are left out."""
    names = []
    root = real_path(path)
    for number, file in enumerate(path.rglob("*")):
        if number >= _MOST_FILES:
            raise InputError(f"has more than {_MOST_FILES:,} files", where=path)
        if not file.is_dir() and real_path(file).is_relative_to(root):
            names.append(file.relative_to(path).as_posix())
    return sorted(names)


def _read_file(path: Path) -> bytes:
    with opened(path) as stream:
        content = stream.read(_MOST_BYTES + 1)
    if len(content) > _MOST_BYTES:
        raise InputError(f"has more than {_MOST_BYTES:,} bytes", where=path)
    return content


def _archive(path: Path) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(path)
    except Exception as error:  # a damaged archive may make the library raise anything
        # The table of contents is at its end.
        what = f"is not a valid zip archive ({reason(error)})"
        raise InputError(what, where=path, hint=COMPLETE) from None


def _members_of(path: Path) -> list[str]:
    """All files of an archive."""
    with _archive(path) as archive:
        entries = archive.infolist()
    if len(entries) > _MOST_FILES:
        raise InputError(f"has more than {_MOST_FILES:,} files", where=path)
    entries = [e for e in entries if not e.is_dir() and not e.filename.startswith("__MACOSX/")]
    for entry in entries:
        if angles_of(entry.filename) is None:
            continue
        name = _short(entry.filename)
        if entry.file_size > min(_MOST_BYTES, _MOST_RATIO * entry.compress_size + 10_000):
            raise InputError(
                f"'{name}' claims {entry.file_size:,} bytes in {entry.compress_size:,}", where=path
            )
    return [entry.filename for entry in entries]


def _read_member(archive: zipfile.ZipFile, name: str, path: Path) -> bytes:
    try:
        entry = archive.getinfo(name)
        with archive.open(entry) as stream:
            data = stream.read(entry.file_size + 1)
    except Exception as error:  # a damaged archive may make the library raise anything
        what = f"'{_short(name)}' cannot be unpacked ({reason(error)})"
        hint = f"{COMPLETE}, or unpack it and give the folder"
        raise InputError(what, where=path, hint=hint) from None
    if len(data) != entry.file_size:
        what = f"'{_short(name)}' has another size than the archive claims"
        raise InputError(what, where=path, hint=COMPLETE)
    return data
