"""Height maps and color maps of many kinds of numbers, channels, sizes and declared color spaces."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from mutations.case import F64, Case, Draws, encoded, linear, quarters

# Chromaticities of red, green, blue and white, and the code of the primaries in cICP.
_SPACES: dict[str, Any] = {
    "Rec.709": ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06), (0.3127, 0.3290), 1),
    "P3": ((0.68, 0.32), (0.265, 0.69), (0.15, 0.06), (0.3127, 0.3290), 12),
    "Rec.2020": ((0.708, 0.292), (0.17, 0.797), (0.131, 0.046), (0.3127, 0.3290), 9),
    "ACEScg": ((0.713, 0.293), (0.165, 0.83), (0.128, 0.044), (0.32168, 0.33767), 0),
}
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
_LOSSY = ("DWAA", "DWAB", "B44", "PXR24")


def _xyz(x: float, y: float) -> F64:
    return np.array([x / y, 1.0, (1 - x - y) / y])


def to_xyz(name: str, white: tuple[float, float]) -> F64:
    """RGB → XYZ of a space, adapted to a white by Bradford's method."""
    *primaries, own, _ = _SPACES[name]
    matrix = np.stack([_xyz(*place) for place in primaries], axis=1)
    matrix = matrix * np.linalg.solve(matrix, _xyz(*own))
    gain = np.diag(_BRADFORD @ _xyz(*white) / (_BRADFORD @ _xyz(*own)))
    return np.asarray(np.linalg.solve(_BRADFORD, gain @ _BRADFORD @ matrix))


def height(d: Draws, folder: Path) -> Case:
    """A gray image as height map."""
    whole = d.rng.integers(0, 65536, (12, 16))
    kinds = (
        "png8",
        "png16",
        "npy",
        "tif16",
        "tif float",
        "tif int16",
        "tif uint32",
        "exr",
        "meters",
        "nodata",
    )
    kind = d.pick(kinds, "height")
    path = folder / f"h.{kind[:3] if kind[:3] in ('png', 'npy', 'exr') else 'tif'}"
    values, refuse, tolerance, tell = whole / 65535.0, False, 1e-6, tuple[str, ...]()
    entry: Any = {"file": path.name, "scale": 0.05, "dequantize": False}
    if kind.startswith("png"):
        depth = int(kind[3:])
        values = (codes := whole >> 16 - depth) / (2**depth - 1)
        channels = d.pick((1, 1, 2), "channels")
        opaque = np.stack([codes, codes * 0 + 2**depth - 1], axis=-1)[..., :channels]
        path.write_bytes(png(opaque, 0 if channels == 1 else 4, depth))
    elif kind == "npy":
        values = values.astype(d.pick(("f4", "f8", "f2"), "of type")).astype(float)
        if refuse := d.chance(0.3, "NaN"):
            values[3, 4] = np.nan
        np.save(path, values)
    elif kind == "exr":
        values = values.astype(d.pick(("f4", "f2"), "of type"))
        channel = d.pick(("Y", "Z", "R", "height", "displacement.Y"), "channel")
        if write_exr(path, {channel: values}, d) in _LOSSY:
            tolerance = 0.1
    else:
        import tifffile

        packed = {"compression": "deflate", "predictor": True}
        options: Any = d.pick(({}, packed, {"tile": (16, 16)}, {"bigtiff": True}, {"byteorder": ">"}), "with")
        if kind == "tif16":
            array: Any = whole.astype("u2")
        elif kind == "tif int16":
            array, tell = (whole // 2 - 9000).astype("i2"), ("signed", "int16")
        elif kind == "tif uint32":
            array, tell = whole.astype("u4") << 16, ("uint32",)
        else:
            array = values.astype("f4")
        if kind == "meters":
            array, tell = array * 80 + 300, ("scale",)
            del entry["scale"]
        elif kind == "nodata":
            array[2, 5:9] = number = d.pick((-9999.0, -32768.0, -3.4028234663852886e38))
            tell, refuse = ("nodata",), True
            tags = [(42113, "s", 0, f"{number:g}", True)]
            options = {"extratags": tags if d.chance(0.5, "tagged") else []}
        tifffile.imwrite(path, array, photometric="minisblack", **options)
        values = values if kind == "tif16" else array.astype(float)
        tolerance = 1.0 if "int" in kind else tolerance
    (folder / "material.yaml").write_text(json.dumps({"height": entry}))
    return _case(folder, "height", values, tolerance, refuse, tell)


def color(d: Draws, folder: Path) -> Case:
    """A color image in a declared color space, beside a height map that may have another size."""
    space = d.pick(("Rec.709", "Rec.709", "P3", "Rec.2020", "ACEScg"), "color space")
    form = d.pick(("png8", "png16", "jpg", "exr", "tif"), "file")
    codes = quarters(d.rng).astype(int) * 257
    values, path = linear(codes / 65535.0), folder / f"c.{form[:3]}"
    *chromaticities, code = _SPACES[space]
    if form == "exr":
        values = (codes / 65535.0).astype("f4")
        header = {"chromaticities": tuple(c for place in chromaticities for c in place)}
        channels = {name: values[..., k] for k, name in enumerate("RGB")}
        write_exr(path, channels, d, {} if space == "Rec.709" else header)
    else:
        profile = icc(space, d.pick((space, f"{space} Gamut with sRGB Transfer"), "profile"))
        if form.startswith("png"):
            red, green, blue, white = chromaticities
            places = (round(1e5 * c) for place in (white, red, green, blue) for c in place)
            chunks = [
                [(b"iCCP", b"profile\0\0" + zlib.compress(profile))],
                [(b"gAMA", struct.pack(">I", 45455)), (b"cHRM", struct.pack(">8I", *places))],
                [(b"cICP", bytes([code, 13, 0, 1]))],
            ]
            chunk = d.pick(chunks[: 3 if code else 2])
            d.words.append(chunk[-1][0].decode())
            depth = int(form[3:])
            path.write_bytes(png(codes >> 16 - depth, 2, depth, chunk))
        else:
            small = (codes >> 8).astype(np.uint8)
            path.write_bytes(encoded(small, "JPEG" if form == "jpg" else "TIFF", icc_profile=profile))
    wanted = np.linalg.solve(to_xyz("Rec.709", (0.3127, 0.3290)), to_xyz(space, (0.3127, 0.3290)))
    values = np.clip(values @ wanted.T, 0.0, 1.0)
    shape = d.pick(((16, 16), (16, 16), (8, 8), (1, 16), (16, 20)), "heights")
    np.save(folder / "h.npy", np.zeros(shape, "f4"))
    (folder / "material.yaml").write_text(json.dumps({"height": "h.npy", "base_color": path.name}))
    told = ("profile", "primaries", "chromaticit", "color space", "cicp")
    return _case(folder, "base_color", values, 0.02, shape[0] != shape[1], () if space == "Rec.709" else told)


def _case(folder: Path, role: str, values: F64, near: float, refuse: bool, tell: tuple[str, ...]) -> Case:
    def check(tile: Any) -> bool:
        found = tile.height if role == "height" else tile.maps[role]
        return bool(np.shape(found) == np.shape(values) and np.abs(found - values).max() <= near)

    return Case(folder / "material.yaml", check, refuse, tell, bool(tell), not (refuse or tell))


def make(d: Draws, folder: Path) -> Case:
    """One of the two."""
    return height(d, folder) if d.chance(0.5) else color(d, folder)


def png(codes: Any, color: int, depth: int, extra: Any = ()) -> bytes:
    """A PNG file of codes (H, W, C)."""
    lines = b"".join(b"\0" + row.astype(">u2" if depth == 16 else "u1").tobytes() for row in codes)
    head = struct.pack(">IIBBBBB", codes.shape[1], codes.shape[0], depth, color, 0, 0, 0)
    out = b"\x89PNG\r\n\x1a\n"
    for name, data in [(b"IHDR", head), *extra, (b"IDAT", zlib.compress(lines)), (b"IEND", b"")]:
        out += struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
    return out


def icc(space: str, name: str) -> bytes:
    """A matrix profile of version 2 with the sRGB curve, as its specification (ICC.1:2001-04) defines it."""
    matrix = to_xyz(space, (0.34567, 0.35850))
    fixed = [struct.pack(">4s4x3i", b"XYZ ", *(round(65536 * c) for c in row)) for row in matrix.T.tolist()]
    codes = np.rint(65535 * linear(np.arange(1024) / 1023)).astype(">u2")
    curve = struct.pack(">4s4xI", b"curv", 1024) + codes.tobytes()
    text = name.encode() + b"\0"
    described = struct.pack(">4s4xI", b"desc", len(text)) + text + bytes(78)
    white = struct.pack(">3i", 63190, 65536, 54061)
    contents = (described, b"XYZ \0\0\0\0" + white, *fixed, curve, curve, curve)
    names = (b"desc", b"wtpt", b"rXYZ", b"gXYZ", b"bXYZ", b"rTRC", b"gTRC", b"bTRC")
    table, body = struct.pack(">I", len(names)), b""
    for tag, content in zip(names, contents, strict=True):
        content += bytes(-len(content) % 4)
        table += struct.pack(">4sII", tag, 132 + 12 * len(names) + len(body), len(content))
        body += content
    size = 128 + len(table) + len(body)
    head = struct.pack(">I4sI4s4s4s12x4s", size, b"", 0x02100000, b"mntr", b"RGB ", b"XYZ ", b"acsp")
    return (head.ljust(68, b"\0") + white).ljust(128, b"\0") + table + body


def write_exr(path: Path, channels: dict[str, Any], d: Draws, header: Any = None) -> str:
    """Write an EXR file with a drawn compression, and name that."""
    import OpenEXR

    name = str(d.pick(("NO", "ZIP", "PIZ", "RLE", *_LOSSY), "compression"))
    head = {"compression": getattr(OpenEXR, f"{name}_COMPRESSION"), "type": OpenEXR.scanlineimage}
    arrays = {name: OpenEXR.Channel(np.ascontiguousarray(a)) for name, a in channels.items()}
    OpenEXR.File(head | (header or {}), arrays).write(str(path))
    return name
