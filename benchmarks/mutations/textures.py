"""Texture sets in the customary names of sites and programs, and images of many kinds of numbers."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from mutations.case import F64, Case, Draws, Rng, damaged, encoded, linear, quarters

# Of each style the form of its file names, {b} being the material's name, {r} its resolution and {m} the
# map, and the maps. Packed maps name their channels; "-x" is 1 - x; "dx" a normal map with green down; "" is
# not used.
_STYLES: dict[str, tuple[str, str]] = {
    "ambientCG": (
        "{b}_{r}-JPG_{m}.jpg",
        "Color=color Displacement=height NormalGL=normal NormalDX=dx Roughness=rough Metalness=metal AO=",
    ),
    "Poly Haven": ("{b}_{m}_{r}.png", "diff=color disp=height nor_gl=normal rough=rough ao="),
    "Poly Haven arm": ("{b}_{m}_{r}.png", "diff=color disp=height arm=,rough,metal"),
    "Poliigon old": (
        "{b}_{m}_{r}.png",
        "COL_VAR1=color COL_VAR2= DISP= DISP16=height NRM=normal GLOSS=-rough REFL=",
    ),
    "Poliigon": (
        "Poliigon_{b}_{m}.jpg",
        "BaseColor=color Displacement=height Normal=normal Roughness=rough Metallic=metal AmbientOcclusion=",
    ),
    "Megascans": (
        "{b}_{r}_{m}.jpg",
        "Albedo=color Displacement=height Normal=normal Roughness=rough AO= Cavity= Bump= Specular= Gloss=",
    ),
    "Substance": (
        "{b}_{m}.png",
        "Base_Color=color Height=height Normal_OpenGL=normal Roughness=rough Metallic=metal Mixed_AO=",
    ),
    "Substance packed": (
        "{b}_{m}.png",
        "Base_Color=color Height=height Normal_DirectX=dx OcclusionRoughnessMetallic=,rough,metal",
    ),
    "Unity HDRP": ("{b}_{m}.png", "BaseMap=color Height=height Normal=normal MaskMap=metal,,,-rough"),
    "Unity": (
        "{b}_{m}.png",
        "AlbedoTransparency=color Height=height Normal=normal MetallicSmoothness=metal,,,-rough",
    ),
    "Unreal": ("T_{b}_{m}.png", "BaseColor=color H=height N=dx ORM=,rough,metal"),
    "cgbookcase": ("{b}_{r}_{m}.jpg", "BaseColor=color Height=height Normal=normal Roughness=rough AO="),
    "FreePBR": (
        "{b}-{m}.png",
        "albedo=color height=height normal-ogl=normal roughness=rough metallic=metal ao= preview=",
    ),
    "3dtextures": (
        "{b}_005_{m}.jpg",
        "basecolor=color height=height normal=normal roughness=rough ambientOcclusion=",
    ),
    "Textures.com": (
        "TexturesCom_{b}_2x2_{r}_{m}.tif",
        "albedo=color height=height normal=normal roughness=rough ao=",
    ),
    "RMA": ("{b}_{m}.png", "albedo=color height=height normal_gl=normal RMA=rough,metal,"),
    "MRAO": ("{b}_{m}.png", "diffuse=color height=height MRAO=metal,rough,"),
    "gloss": ("{b}_{m}.png", "diffuse=color displacement=height glossiness=-rough specular="),
}
_ROLES = {
    "color": "base_color",
    "height": "height",
    "normal": "normal",
    "rough": "roughness",
    "metal": "metallic",
}


def named(rng: Rng, folder: Path) -> Case:
    """A folder of maps with distinct contents; what a map's name defines is used, or said not to be."""
    d = Draws(rng)
    form, listed = _STYLES[d.pick(_STYLES, "names of")]
    maps = dict(word.split("=") for word in listed.split())
    base = d.pick(
        ("rock_wall_08", "Metal032", "Ground Grass", "ColorTiles", "RoughPlaster", "NormalBrick", "ue4kfcqs"),
        "of",
    )
    words = {"b": base, "r": d.pick(("1K", "2k", "4K"))}
    height = np.kron(rng.integers(60, 200, (4, 4)), np.ones((4, 4))).astype(np.uint8)
    slopes = (
        np.stack([np.roll(height, 1, a) - np.roll(height, -1, a).astype(float) for a in (1, 0)], axis=-1)
        / 400.0
    )
    normal = np.concatenate([slopes * (1, -1), np.ones((16, 16, 1))], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    codes = {name: quarters(rng)[..., 0] for name in ("rough", "metal")}
    codes |= {
        "color": quarters(rng),
        "height": height,
        "normal": np.rint(127.5 * normal + 127.5).astype(np.uint8),
    }
    codes["dx"] = codes["normal"] * np.array([1, 0, 1], np.uint8) + (255 - codes["normal"]) * np.array(
        [0, 1, 0], np.uint8
    )
    expected: dict[str, tuple[str, F64]] = {}
    dropped = d.pick(list(maps)) if d.chance(0.3) else ""
    for word, content in maps.items():
        name = form.format(**words, m=word)
        if word == dropped and content != "height":
            d.words.append(f"without {name}")
            continue
        kind = {"jpg": "JPEG", "tif": "TIFF", "png": "PNG"}[name.rsplit(".", 1)[1]]
        parts = content.split(",") if "," in content else None
        if parts is not None:
            image = np.stack([_channel(part, codes) for part in parts], axis=-1)
        else:
            image = codes[content] if content in codes else _channel(content, codes)
        (folder / name).write_bytes(
            encoded(image, kind, **({"quality": 98, "subsampling": 0} if kind == "JPEG" else {}))
        )
        for part in parts or [content]:
            plain = part.removeprefix("-").replace("dx", "normal")
            if plain in _ROLES:
                expected[_ROLES[plain]] = (name, _values(plain, codes))

    def check(tile: Any) -> bool:
        said = " ".join([*tile.warnings, *tile.unused])
        for role in ("base_color", "roughness", "metallic", "normal", "opacity"):
            found = tile.maps.get(role)
            name, wanted = expected.get(role, ("", None))
            if wanted is None:
                # A map in the place of another, or a number in its place.
                if isinstance(found, np.ndarray) and found.ndim > 1:
                    return False
            elif np.shape(found)[:2] == (16, 16):
                if np.abs(found - wanted).mean() > (0.1 if role == "normal" else 0.02):
                    return False
            elif name not in said:
                return False
        return tile.files["height"].name == expected["height"][0] or expected["height"][0] in said

    return Case(folder, ", ".join(d.words), check)


def _channel(part: str, codes: dict[str, Any]) -> Any:
    """Codes of a channel: a map, its inverse, or something that is not used."""
    if part.startswith("-"):
        return 255 - codes[part[1:]]
    return codes.get(part, np.roll(codes["rough"] // 2 + 90, 5, axis=0))


def _values(name: str, codes: dict[str, Any]) -> F64:
    array = np.asarray(codes[name], np.float64) / 255.0
    return linear(array) if name == "color" else 2 * array - 1 if name == "normal" else array


# Chromaticities of red, green, blue and white, and the code of the primaries in cICP.
_SPACES: dict[str, Any] = {
    "Rec.709": ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06), (0.3127, 0.3290), 1),
    "P3": ((0.68, 0.32), (0.265, 0.69), (0.15, 0.06), (0.3127, 0.3290), 12),
    "Rec.2020": ((0.708, 0.292), (0.17, 0.797), (0.131, 0.046), (0.3127, 0.3290), 9),
    "ACEScg": ((0.713, 0.293), (0.165, 0.83), (0.128, 0.044), (0.32168, 0.33767), 0),
}
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


def to_xyz(name: str, white: tuple[float, float] | None = None) -> F64:
    """RGB → XYZ of a space, adapted to another white by Bradford's method."""
    *primaries, own, _ = _SPACES[name]
    xyz = [np.array([x / y, 1.0, (1 - x - y) / y]) for x, y in (*primaries, own)]
    matrix = np.array(xyz[:3]).T
    matrix = matrix * np.linalg.solve(matrix, xyz[3])
    if white is None:
        return matrix
    wanted = np.array([white[0] / white[1], 1.0, (1 - sum(white)) / white[1]])
    gain = np.diag(_BRADFORD @ wanted / (_BRADFORD @ xyz[3]))
    return np.asarray(np.linalg.solve(_BRADFORD, gain @ _BRADFORD @ matrix))


def numbers(rng: Rng, folder: Path) -> Case:
    """A height or a color image whose numbers, channels and declarations are drawn."""
    d = Draws(rng)
    role, values, tolerance, refuse, said = d.pick((_height, _color))(folder, d)

    def check(tile: Any) -> bool:
        found = tile.height if role == "height" else tile.maps[role]
        return bool(np.shape(found) == np.shape(values) and np.abs(found - values).max() <= tolerance)

    path = folder / "material.yaml"
    return Case(path, ", ".join(d.words), check, refuse, said, bool(said), not (refuse or said))


# (role, values, tolerance, whether only a refusal is right, words of the warning).
_Made = tuple[str, F64, float, bool, tuple[str, ...]]


def _height(folder: Path, d: Draws) -> _Made:
    """A gray image as height map."""
    rng = d.rng
    kind = d.pick(
        ("png8", "png16", "npy", "tif16", "tif float", "tif int16", "tif uint32", "exr", "meters", "nodata"),
        "height",
    )
    whole = rng.integers(0, 65536, (12, 16))
    values, name = whole / 65535.0, "h." + {"png": "png", "npy": "npy", "exr": "exr"}.get(kind[:3], "tif")
    refuse, tolerance, scale = False, 1e-6, 0.05
    tell: tuple[str, ...] = ()
    path = folder / name
    entry: Any = {"file": name, "scale": scale, "dequantize": False}
    import tifffile

    if kind.startswith("png"):
        depth = int(kind[3:])
        codes = whole if depth == 16 else whole >> 8
        color = d.pick((0, 0, 4), "color type")
        path.write_bytes(
            png(
                np.stack([codes, codes * 0 + 2**depth - 1], -1) if color == 4 else codes[..., None],
                color,
                depth,
            )
        )
        values = codes / (2**depth - 1)
    elif kind == "npy":
        array = values.astype(d.pick(("f4", "f8", "f2")))
        if d.chance(0.3, "NaN"):
            array[3, 4], refuse = np.nan, True
        np.save(path, array)
        values = array.astype(float)
    elif kind == "exr":
        array = values.astype(d.pick(("f4", "f2"), "of type"))
        write_exr(path, {d.pick(("Y", "Z", "R", "height", "displacement.Y"), "channel"): array}, d)
        values = array.astype(float)
    elif kind == "tif16":
        options = d.pick(
            (
                {},
                {"compression": "deflate", "predictor": True},
                {"tile": (16, 16)},
                {"bigtiff": True},
                {"byteorder": ">"},
            )
        )
        tifffile.imwrite(path, whole.astype("u2"), photometric="minisblack", **options)
    elif kind in ("tif float", "nodata", "meters"):
        array = values.astype("f4")
        if kind == "meters":
            array, tell = array * 80 + 300, ("scale",)
            del entry["scale"]
        extra = []
        if kind == "nodata":
            number = d.pick((-9999.0, -32768.0, -3.4028234663852886e38))
            array[2, 5:9], tell, refuse = number, ("nodata",), True
            tagged = d.chance(0.5, "tagged")
            extra = [(42113, "s", 0, f"{number:g}", True)] if tagged else []
        tifffile.imwrite(path, array, photometric="minisblack", extratags=extra)
        values = array.astype(float)
    else:
        signed = kind == "tif int16"
        array = (whole - 20000).clip(-20000, 32767).astype("i2") if signed else (whole.astype("u4") << 16)
        tifffile.imwrite(path, array, photometric="minisblack")
        values, tell, tolerance = array.astype(float), ("signed", "int16", "uint32"), 1.0
    (folder / "material.yaml").write_text(json.dumps({"height": entry}))
    return "height", values, tolerance, refuse, tell


def _color(folder: Path, d: Draws) -> _Made:
    """A color image in a declared color space."""
    rng = d.rng
    space = d.pick(("Rec.709", "Rec.709", "P3", "Rec.2020", "ACEScg"), "color space")
    codes = quarters(rng).astype(int) * 257
    form = d.pick(("png8", "png16", "jpg", "exr", "tif"), "file")
    name = "c." + form[:3]
    wanted = np.linalg.solve(to_xyz("Rec.709"), to_xyz(space, _SPACES["Rec.709"][3]))
    data, values = b"", linear(codes / 65535.0)
    if form == "exr":
        values = (codes / 65535.0).astype("f4").astype(float)
        header = (
            {}
            if space == "Rec.709"
            else {"chromaticities": tuple(c for xy in _SPACES[space][:4] for c in xy)}
        )
        write_exr(folder / name, {c: values[..., k].astype("f4") for k, c in enumerate("RGB")}, d, header)
    else:
        how = d.pick(("icc", "cicp", "chrm") if form.startswith("png") else ("icc",), "declared by")
        if space == "ACEScg" and how == "cicp":
            how = "icc"
        name_of = d.pick((space, f"{space} Gamut with sRGB Transfer")) if how == "icc" else ""
        profile = icc(space, name_of)
        d.words.append(name_of)
        if form.startswith("png"):
            red, green, blue, white = (_SPACES[space][k] for k in range(4))
            chunk = {
                "icc": (b"iCCP", b"profile\0\0" + zlib.compress(profile)),
                "cicp": (b"cICP", bytes([_SPACES[space][4], 13, 0, 1])),
                "chrm": (
                    b"cHRM",
                    struct.pack(">8I", *(round(1e5 * c) for xy in (white, red, green, blue) for c in xy)),
                ),
            }[how]
            extra = [(b"gAMA", struct.pack(">I", 45455)), chunk] if how == "chrm" else [chunk]
            data = png(codes if form == "png16" else codes >> 8, 2, 16 if form == "png16" else 8, extra)
        else:
            kind, best = ("JPEG", {"quality": 100, "subsampling": 0}) if form == "jpg" else ("TIFF", {})
            data = encoded((codes >> 8).astype(np.uint8), kind, icc_profile=profile, **best)
        (folder / name).write_bytes(data)
    values = np.clip(values @ wanted.T, 0.0, 1.0)
    np.save(folder / "h.npy", np.zeros((16, 16), "f4"))
    (folder / "material.yaml").write_text(json.dumps({"height": "h.npy", "base_color": name}))
    told = ("profile", "primaries", "chromaticit", "color space", "cicp")
    return "base_color", values, 0.02, False, () if space == "Rec.709" else told


def png(codes: Any, color: int, depth: int, extra: Any = ()) -> bytes:
    """A PNG file of codes (H, W, C)."""
    lines = b"".join(
        b"\0" + row.astype(">u2" if depth == 16 else "u1").tobytes() for row in np.asarray(codes)
    )
    head = struct.pack(">IIBBBBB", codes.shape[1], codes.shape[0], depth, color, 0, 0, 0)
    chunks = [(b"IHDR", head), *extra, (b"IDAT", zlib.compress(lines)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks
    )


def icc(space: str, name: str) -> bytes:
    """A matrix profile of version 2 with the sRGB curve, as its specification (ICC.1:2001-04) defines it."""
    matrix = to_xyz(space, (0.34567, 0.35850)) if space else np.eye(3)
    fixed = [
        struct.pack(">4s4x3i", b"XYZ ", *(round(65536 * float(c)) for c in matrix[:, k])) for k in range(3)
    ]
    curve = (
        struct.pack(">4s4xI", b"curv", 1024)
        + np.rint(65535 * linear(np.arange(1024) / 1023)).astype(">u2").tobytes()
    )
    text = name.encode() + b"\0"
    described = struct.pack(">4s4xI", b"desc", len(text)) + text + bytes(78)
    white = struct.pack(">4s4x3i", b"XYZ ", 63190, 65536, 54061)
    tags = dict(
        zip(
            (b"desc", b"wtpt", b"rXYZ", b"gXYZ", b"bXYZ", b"rTRC", b"gTRC", b"bTRC"),
            (described, white, *fixed, curve, curve, curve),
            strict=True,
        )
    )
    table, body = b"", b""
    for tag, content in tags.items():
        content += bytes(-len(content) % 4)
        table += struct.pack(">4sII", tag, 132 + 12 * len(tags) + len(body), len(content))
        body += content
    head = struct.pack(">I4sI4s4s4s12x4s", 0, b"", 0x02100000, b"mntr", b"RGB ", b"XYZ ", b"acsp").ljust(
        68, b"\0"
    )
    head += struct.pack(">3i", 63190, 65536, 54061)
    out = head.ljust(128, b"\0") + struct.pack(">I", len(tags)) + table + body
    return struct.pack(">I", len(out)) + out[4:]


def write_exr(path: Path, channels: dict[str, Any], d: Draws, header: Any = None) -> None:
    """An EXR file of a drawn lossless compression."""
    import OpenEXR

    kinds = (
        OpenEXR.NO_COMPRESSION,
        OpenEXR.ZIP_COMPRESSION,
        OpenEXR.PIZ_COMPRESSION,
        OpenEXR.RLE_COMPRESSION,
    )
    head = {"compression": d.pick(kinds), "type": OpenEXR.scanlineimage, **(header or {})}
    OpenEXR.File(
        head, {name: OpenEXR.Channel(np.ascontiguousarray(a)) for name, a in channels.items()}
    ).write(str(path))


def damage(rng: Rng, folder: Path) -> Case:
    """An image of :func:`numbers` with damaged bytes."""
    case, d = numbers(rng, folder), Draws(rng)
    image = next(p for p in sorted(folder.iterdir()) if p.suffix not in (".yaml",))
    image.write_bytes(damaged(image.read_bytes(), d))
    return Case(case.path, f"{case.text}; {', '.join(d.words)}")
