"""Photographs whose names are the directions, in a folder or a zip archive: UBO2003 and its relatives.

The BTF Database Bonn of 2003 (Sattler, Sarlette and Klein 2003, "Efficient and realistic visualization of
cloth") has 81 lights and 81 views, 256 x 256 texels, as archives of JPEG images. Each name has four angles in
degrees: ``00001 tl000 pl000 tv000 pv000.jpg`` has the light's polar angle and azimuth, then the viewer's. The
separators, the order and the folders vary (UTIA: ``tv000_pv000/tl000_pl000_tv000_pv000.png``); the four
letters do not. The readers btf-extractor and btf-rendering, and UTIA's description, agree on this.

Nothing says these three: the codes are taken as sRGB; azimuths run from the images' right side to their top;
and whether the values include the cosine of the light is left open (plain photographs do).
"""

from __future__ import annotations

import io
import re
import warnings as python_warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.color import srgb_to_linear
from mbtf_core.errors import InputError, reason
from mbtf_core.paths import refuse_special
from mbtf_gen.measured.interface import I64, ImageBtf, check_texels, from_angles

SUFFIXES = (".jpg", ".jpeg", ".png")
_ANGLES = tuple(
    re.compile(rf"(?<![a-z]){letters}(\d{{1,3}}(?:\.\d+)?)") for letters in ("tl", "pl", "tv", "pv")
)
_MOST_FILES = 200_000
# Largest file of an image, and the largest ratio to its compressed size in an archive.
_MOST_BYTES = 1 << 28
_MOST_RATIO = 100
# Linear values of the codes.
_LINEAR = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)


class Ubo2003(ImageBtf):
    """Photographs in a folder, which may have sub-folders, or in a zip archive. Nothing is unpacked to disk.

    Raises
    ------
    InputError : no image is named by its directions, two have the same, there are too many, or the first
        cannot be decoded
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        names, self._content = _folder(path) if path.is_dir() else _archive(path)
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
                )
            table[angles] = name
        if not table:
            raise InputError(
                "has no JPG or PNG images that are named by their directions",
                where=path,
                hint="a name has the angles of the light and the viewer: tl015 pl060 tv030 pv090.jpg",
            )
        self._names = [table[angles] for angles in sorted(table)]
        radians = np.deg2rad(sorted(table))
        light, view = from_angles(radians[:, 0], radians[:, 1]), from_angles(radians[:, 2], radians[:, 3])
        super().__init__(path, 0, 0, light, view)
        if not len(self._number):
            raise InputError("has no image with light and view above the horizon", where=path)
        self.rows, self.columns = self._decoded(int(self._number[0])).shape[:2]

    def _texels(self, file: Any, number: int, row: I64, column: I64) -> NDArray[np.float32]:
        codes = self._decoded(number)
        if codes.shape[:2] != (self.rows, self.columns):
            raise InputError(
                f"'{self._names[number]}' has {codes.shape[1]} x {codes.shape[0]} texels,"
                f" other images {self.columns} x {self.rows}",
                where=self.path,
            )
        return _LINEAR[codes[row, column]]

    def _decoded(self, number: int) -> NDArray[np.uint8]:
        """Codes (H, W, 3) of an image; gray becomes RGB."""
        from PIL import Image as Pillow

        name = self._names[number]
        content = self._content(name)
        try:
            with python_warnings.catch_warnings():
                python_warnings.simplefilter("ignore")
                with Pillow.open(io.BytesIO(content), formats=["JPEG", "PNG"]) as picture:
                    check_texels(picture.height, picture.width, self.path)
                    if picture.mode not in ("RGB", "L"):
                        raise InputError(f"'{name}' has the pixel mode '{picture.mode}'", where=self.path)
                    return np.asarray(picture.convert("RGB"))
        except InputError:
            raise
        except Exception as error:  # a damaged file may make the decoder raise anything
            raise InputError(
                f"'{_short(name)}' cannot be decoded ({reason(error)})", where=self.path
            ) from None


def angles_of(name: str) -> tuple[float, float, float, float] | None:
    """Polar angle and azimuth of the light, then of the viewer, in degrees; None of other names."""
    stem = name.replace("\\", "/").rsplit("/", 1)[-1].lower()
    if not stem.endswith(SUFFIXES):
        return None
    found = [pattern.findall(stem) for pattern in _ANGLES]
    if any(len(numbers) != 1 for numbers in found):
        return None
    tl, pl, tv, pv = (float(numbers[0]) for numbers in found)
    return tl, pl, tv, pv


def _short(name: str) -> str:
    return name if len(name) <= 80 else f"...{name[-77:]}"


def _folder(path: Path) -> tuple[list[str], Callable[[str], bytes]]:
    names = []
    root = path.resolve()
    for file in path.rglob("*"):
        if file.suffix.lower() in SUFFIXES and file.resolve().is_relative_to(root):
            names.append(file.relative_to(path).as_posix())
        if len(names) > _MOST_FILES:
            raise InputError(f"has more than {_MOST_FILES:,} images", where=path)

    def content(name: str) -> bytes:
        file = path / name
        refuse_special(file)
        try:
            if file.stat().st_size > _MOST_BYTES:
                raise InputError(f"has more than {_MOST_BYTES:,} bytes", where=file)
            return file.read_bytes()
        except OSError as error:
            raise InputError(f"cannot be read ({error.strerror})", where=file) from None

    return names, content


def _archive(path: Path) -> tuple[list[str], Callable[[str], bytes]]:
    refuse_special(path)
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=path) from None
    except Exception as error:  # a damaged archive may make the library raise anything
        raise InputError(f"is not a valid zip archive ({reason(error)})", where=path) from None
    if len(entries) > _MOST_FILES:
        raise InputError(f"has more than {_MOST_FILES:,} files", where=path)
    by_name: dict[str, zipfile.ZipInfo] = {}
    for entry in entries:
        if angles_of(entry.filename) is None or entry.filename.startswith("__MACOSX/"):
            continue
        name = entry.filename
        if entry.file_size > min(_MOST_BYTES, _MOST_RATIO * entry.compress_size + 10_000):
            raise InputError(
                f"'{_short(name)}' claims {entry.file_size:,} bytes in {entry.compress_size:,}", where=path
            )
        by_name[name] = entry

    def content(name: str) -> bytes:
        entry = by_name[name]
        try:
            with zipfile.ZipFile(path) as archive, archive.open(entry) as stream:
                data = stream.read(entry.file_size + 1)
        except Exception as error:  # a damaged archive may make the library raise anything
            raise InputError(f"'{_short(name)}' cannot be unpacked ({reason(error)})", where=path) from None
        if len(data) != entry.file_size:
            raise InputError(f"'{_short(name)}' has another size than the archive claims", where=path)
        return data

    return list(by_name), content
