"""Color spaces that image files declare, and their conversion to linear Rec.709.

Primaries are converted by a matrix that adapts the white point to D65 (Bradford). ICC profiles are read if
they consist of a matrix and of one curve per channel, or of one curve for gray.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mbtf_core.color import srgb_to_linear
from mbtf_core.errors import printable

ColorSpace = Literal["srgb", "linear"]
F64 = NDArray[np.float64]
Curve = Callable[[F64], F64]

# Chromaticities x, y of red, green, blue and white.
REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
ADOBE_RGB = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.3290)
_PRIMARIES = {
    "Rec.2020": (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290),
    "Display P3": (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290),
    "DCI-P3": (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.314, 0.351),
    "ACEScg": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767),
    "ACES2065-1": (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767),
    "Adobe RGB (1998)": ADOBE_RGB,
    "Rec.601 (625 lines)": (0.64, 0.33, 0.29, 0.60, 0.15, 0.06, 0.3127, 0.3290),
    "Rec.601 (525 lines)": (0.630, 0.340, 0.310, 0.595, 0.155, 0.070, 0.3127, 0.3290),
}
# Color primaries of ITU-T H.273 by code.
_CODED = {
    1: REC709,
    5: _PRIMARIES["Rec.601 (625 lines)"],
    6: _PRIMARIES["Rec.601 (525 lines)"],
    7: _PRIMARIES["Rec.601 (525 lines)"],
    9: _PRIMARIES["Rec.2020"],
    11: _PRIMARIES["DCI-P3"],
    12: _PRIMARIES["Display P3"],
}
# Tolerance of the comparison of chromaticities, of matrices and of curves.
_SAME = 2e-3
# Tolerance of the ends of a curve.
_ENDS = 0.2
# Cone responses of Bradford.
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
# White of the connection space of ICC profiles.
_D50 = np.array([0.9642, 1.0, 0.8249])


@dataclass(frozen=True)
class DeclaredSpace:
    """A color space that a file declares.

    Attributes
    ----------
    name : for messages
    curves : linear light of the encoded numbers of each channel: three, one for gray, or none where the
        numbers are linear
    matrix : (3, 3), linear RGB to linear Rec.709; None where the primaries are those of Rec.709
    """

    name: str
    curves: tuple[Curve, ...] = ()
    matrix: F64 | None = None

    @property
    def known(self) -> ColorSpace | None:
        """``srgb`` or ``linear`` where that is what the space is, else None."""
        if self.matrix is not None:
            return None
        at = np.linspace(0.0, 1.0, 256)
        if all(np.abs(curve(at) - at).max() < _SAME for curve in self.curves):
            return "linear"
        decoded = srgb_to_linear(at)
        return "srgb" if all(np.abs(curve(at) - decoded).max() < _SAME for curve in self.curves) else None


def power(exponent: float) -> Curve:
    """The curve ``x ** exponent``, with negative numbers mirrored."""
    return lambda x: np.sign(x) * np.abs(x) ** exponent


def srgb(x: F64) -> F64:
    """The curve of sRGB."""
    return np.asarray(srgb_to_linear(x), np.float64)


def rec709(x: F64) -> F64:
    """The curve of Rec.709, Rec.601 and Rec.2020 (inverse of the camera's, ITU-R BT.709-6)."""
    return np.where(x < 0.081, x / 4.5, ((np.maximum(x, 0.0) + 0.099) / 1.099) ** (1.0 / 0.45))


def rgb_to_xyz(chromaticities: Sequence[float]) -> F64:
    """The matrix (3, 3) from linear RGB to XYZ whose white has Y = 1, by x, y of red, green, blue and white;
    a ValueError where they span no color space."""
    x, y = np.reshape(np.asarray(chromaticities, np.float64), (4, 2)).T
    xyz = np.stack([x, y, 1.0 - x - y])
    if not np.isfinite(xyz).all() or y[3] <= 0 or abs(np.linalg.det(xyz[:, :3])) < 1e-6:
        raise ValueError("no color space")
    return np.asarray(xyz[:, :3] * np.linalg.solve(xyz[:, :3], xyz[:, 3] / y[3]), np.float64)


def adaptation(white: F64, target: F64) -> F64:
    """Bradford's matrix (3, 3) of XYZ from one white to another."""
    gain = (_BRADFORD @ target) / (_BRADFORD @ white)
    return np.asarray(np.linalg.solve(_BRADFORD, gain[:, None] * _BRADFORD), np.float64)


def _to_rec709(to_xyz: F64, white: F64) -> F64 | None:
    """Linear RGB to linear Rec.709; None where it is the same."""
    target = rgb_to_xyz(REC709)
    matrix: F64 = np.asarray(np.linalg.solve(target, adaptation(white, target.sum(axis=1)) @ to_xyz))
    if not np.isfinite(matrix).all():
        raise ValueError("no color space")
    return None if np.abs(matrix - np.eye(3)).max() < _SAME else matrix


def from_chromaticities(chromaticities: Sequence[float], *curves: Curve) -> DeclaredSpace:
    """The space of given primaries and curves; a ValueError where the chromaticities span none."""
    to_xyz = rgb_to_xyz(chromaticities)
    named = (n for n, p in _PRIMARIES.items() if np.abs(np.subtract(p, chromaticities)).max() < _SAME)
    name = next(named, "own primaries")
    return DeclaredSpace(name, curves, _to_rec709(to_xyz, to_xyz.sum(axis=1)))


def from_cicp(content: bytes) -> DeclaredSpace:
    """The space of a ``cICP`` chunk of PNG (ITU-T H.273); a ValueError where it is not supported, such as HDR
    video."""
    primaries, transfer, matrix, full = struct.unpack(">4B", content)
    curves: dict[int, tuple[Curve, ...]] = {
        **dict.fromkeys((1, 6, 14, 15), (rec709,) * 3),
        4: (power(2.2),) * 3,
        5: (power(2.8),) * 3,
        8: (),
        13: (srgb,) * 3,
    }
    if primaries not in _CODED or transfer not in curves or matrix != 0 or full != 1:
        raise ValueError("not supported")
    return from_chromaticities(_CODED[primaries], *curves[transfer])


def from_icc(profile: bytes, name: str) -> DeclaredSpace:
    """The space of an ICC profile of a matrix and curves, or of a curve for gray (ICC.1:2022, 8.3, 8.4); a
    ValueError for another kind, or a damaged one. `name` is its description."""
    try:
        space, connection = profile[16:20], profile[20:24]
        (count,) = struct.unpack_from(">I", profile, 128)
        tags = {}
        for i in range(min(count, 200)):
            key, offset, size = struct.unpack_from(">4sII", profile, 132 + 12 * i)
            tags[key] = profile[offset : offset + size]
        gray = space == b"GRAY"
        # Curves to Lab are those of the lightness.
        if connection != b"XYZ " or space not in (b"GRAY", b"RGB "):
            raise ValueError("not a matrix")
        curves = tuple(_curve(tags[key]) for key in ((b"kTRC",) if gray else (b"rTRC", b"gTRC", b"bTRC")))
        if gray:
            return DeclaredSpace(printable(name), curves)
        columns = [struct.unpack_from(">3i", tags[key], 8) for key in (b"rXYZ", b"gXYZ", b"bXYZ")]
        return DeclaredSpace(printable(name), curves, _to_rec709(np.array(columns).T / 65536.0, _D50))
    except (KeyError, struct.error, np.linalg.LinAlgError) as error:
        raise ValueError("damaged, or of another kind") from error


def _curve(tag: bytes) -> Curve:
    """The curve of an element, which rises from about 0 to about 1."""
    curve = _element(tag)
    with np.errstate(all="ignore"):
        ends = curve(np.linspace(0.0, 1.0, 256))[[0, -1]]
    if not np.abs(ends - (0.0, 1.0)).max() < _ENDS:
        raise ValueError("no curve")
    return curve


def _element(tag: bytes) -> Curve:
    """A ``curv`` or ``para`` element of an ICC profile (ICC.1:2022, 10.6, 10.18)."""
    if tag[:4] == b"curv":
        (count,) = struct.unpack_from(">I", tag, 8)
        if count == 0:
            return power(1.0)
        if count == 1:
            return power(struct.unpack_from(">H", tag, 12)[0] / 256.0)
        table = np.frombuffer(tag, ">u2", count, 12) / 65535.0
        return lambda x: np.interp(x, np.linspace(0.0, 1.0, count), table)
    (kind,) = struct.unpack_from(">H", tag, 8)
    if tag[:4] != b"para" or kind > 4:
        raise ValueError("unknown curve")
    given = [n / 65536.0 for n in struct.unpack_from(f">{(1, 3, 4, 5, 7)[kind]}i", tag, 12)]
    g, a, b, c, d, e, f = given + [1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0][len(given) :]
    if kind in (1, 2):
        # Both are constant below -b/a.
        d, e, f = (-b / a if a else 0.0), (c if kind == 2 else 0.0), (c if kind == 2 else 0.0)
        c = 0.0
    return lambda x: np.where(x >= d, np.maximum(a * x + b, 0.0) ** g + e, c * x + f)
