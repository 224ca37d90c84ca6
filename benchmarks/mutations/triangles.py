"""OBJ with materials, and PLY, written from their descriptions."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from mutations.case import (
    F64,
    PLACES,
    Case,
    Draws,
    Rng,
    agree,
    damaged,
    encoded,
    hit,
    linear,
    looked_up,
    patch,
    quarters,
)

_REPEAT = ("repeat", "repeat")
# Statements of materials that may be used or not, and words of the warning.
_IGNORED = {
    "Ke 1 0 0": ("ke", "emi"),
    "map_Bump bump.png": ("bump", "normal"),
    "map_d bump.png": ("map_d", "opacity", "transparen"),
    "d 0.3": ("'d'", " d ", "d 0.3", "opacity", "opaque", "transparen"),
}


def obj(rng: Rng, folder: Path) -> Case:
    """A bumpy tile as OBJ, z up, with a material file. Kd is linear and multiplies its map; colors of
    vertices are sRGB, as in most files."""
    d = Draws(rng)
    vertices, faces = patch(rng)
    form = d.pick(("v/vt", "v/vt/vn", "negative", "squares"))
    d.words.append(form)
    if form == "squares":  # no two readers need to agree on the diagonals of bent ones
        vertices[:, 2] = 0.0
    uv = vertices[:, :2] * d.pick((1.0, 2.0, -1.0)) + d.pick((0.0, 0.25, -3.0))
    codes = quarters(rng)
    texture, to_uv, wrap = None, np.eye(2, 3), _REPEAT
    factor = np.array([d.number(0, 1), d.number(0, 1), d.number(0, 0.05)])
    mtl = [
        "# a comment",
        "newmtl other",
        "Kd 0.1 0.2 0.3",
        "newmtl m",
        f"Kd {factor[0]} {factor[1]} {factor[2]}",
    ]
    tell: tuple[str, ...] = ()
    refuse = unless = False
    opacity: F64 | None = None
    if d.chance(0.6):
        name = d.pick(("map.png", "my map.png", "sub/map.png"), "map")
        (folder / "sub").mkdir()
        (folder / name).write_bytes(encoded(codes))
        texture = linear(codes / 255.0)
        if d.chance(0.5, "Kd 1"):
            factor, mtl[4] = np.ones(3), "Kd 1 1 1"
        written = name
        if name == "sub/map.png":
            written = d.pick(
                ("sub/map.png", "sub\\map.png", "C:\\Users\\me\\sub\\map.png", "Sub/MAP.png"), "written"
            )
        options = ""
        if d.chance(0.4):
            s, o = rng.uniform(0.5, 4, 2).round(2), rng.uniform(-1, 1, 2).round(2)
            options, to_uv = f"-s {s[0]} {s[1]} 1 -o {o[0]} {o[1]} 0 ", np.column_stack([np.diag(s), o])
            d.words.append(options)
        if d.chance(0.2, "-clamp on"):
            options, wrap = options + "-clamp on ", ("clamp", "clamp")
        if d.chance(0.1, "-bm 1"):
            options += "-bm 1 "
        mtl.append(f"map_Kd {options}{written}")
        if d.chance(0.1, "image removed"):
            (folder / name).unlink()
            tell = ("map.png",)
    if d.chance(0.2):
        name = d.pick(_IGNORED, "ignored")
        gray = quarters(rng)[..., 0]
        (folder / "bump.png").write_bytes(encoded(gray))
        mtl.append(name)
        if not tell:
            tell, unless = _IGNORED[name], "d" in name.split()[0].split("_")
            opacity = {"d 0.3": np.full((1, 1), 0.3), "map_d bump.png": gray / 255.0}.get(name)
    colors = np.ones((len(vertices), 3))
    if texture is None and d.chance(0.25, "vertex colors"):
        colors = rng.uniform(0, 1, (len(vertices), 3)).round(3)
    rows = [f"{x:g} {y:g} {z:g}" for x, y, z in vertices]
    if (colors < 1).any():
        rows = [f"{row} {r:g} {g:g} {b:g}" for row, (r, g, b) in zip(rows, colors, strict=True)]
        unless, tell = unless or not tell, tell or ("vertex color", "colors of")
    lines = [
        "mtllib my tile.mtl",
        "o tile",
        *(f"v {row}" for row in rows),
        *(f"vt {a:g} {b:g}" for a, b in uv),
    ]
    lines += ["vn 0 0 1", "usemtl m", "s 1"]
    corners: Any = faces
    if form == "squares":
        corners = [[i, i + 1, i + 5, i + 4] for i in range(11) if i % 4 < 3]
    for face in corners:
        words = []
        for k in face:
            i = int(k) - len(vertices) if form == "negative" else int(k) + 1
            words.append(f"{i}/{i}/1" if form == "v/vt/vn" else f"{i}/{i}")
        lines.append("f " + " ".join(words))
    if d.chance(0.2):
        how = d.pick(
            ("index 99", "NaN", "no mtl", "Kd 1e9", "Kd nan", "usemtl ghost", "text", "f 0"), "broken:"
        )
        refuse = how not in ("no mtl", "usemtl ghost", "text")
        if how == "index 99":
            lines.append("f 99/1 1/1 2/2")
        elif how == "f 0":
            lines.append("f 0 1 2")
        elif how == "NaN":
            lines[2] = "v nan 0 0"
        elif how.startswith("Kd"):
            mtl[4] = f"Kd {how.split()[1]} 0 0"
        elif how == "usemtl ghost":
            lines.insert(len(lines) - len(corners), "usemtl ghost")
            tell, unless = ("ghost",), False
        elif how == "text":
            lines.insert(3, "w o r d s")
            return _obj(folder, lines, mtl, Case(folder / "tile.obj", ", ".join(d.words)))
        else:
            mtl, tell, unless = [], (".mtl",), False
    expected: list[Any] = []
    for x, y in PLACES:
        number, weights, z = hit(vertices, faces, x, y) or (0, np.ones(3), 0.0)
        color = factor * (weights @ linear(colors)[faces[number]])
        if texture is not None:
            u, v = to_uv @ [*(weights @ uv[faces[number]]), 1.0]
            color = color * looked_up(texture, u, v, wrap)
        more = {}
        if opacity is not None:
            u, v = weights @ uv[faces[number]]
            more = {"opacity": looked_up(opacity[..., None], u, v, _REPEAT)}
        expected.append((z - vertices[:, 2].max(), color, more))
    right = lambda tile: agree(tile, expected)  # noqa: E731
    valid = not refuse and (unless or not tell)
    case = Case(folder / "tile.obj", ", ".join(d.words), right, refuse, tell, unless, valid)
    return _obj(folder, lines, mtl, case)


def _obj(folder: Path, lines: list[str], mtl: list[str], case: Case) -> Case:
    (folder / "tile.obj").write_text("\n".join(lines) + "\n")
    if mtl:
        (folder / "my tile.mtl").write_text("\n".join(mtl) + "\n")
    return case


def ply(rng: Rng, folder: Path) -> Case:
    """A bumpy tile as PLY: z up, text or binary, with texture coordinates of vertices or of corners."""
    d = Draws(rng)
    vertices, faces = patch(rng)
    codes, texture = quarters(rng), None
    uv = vertices[:, :2].copy()
    form = d.pick(("ascii", "binary_little_endian", "binary_big_endian"), "form")
    kind = d.pick(("float", "double"))
    header = ["ply", f"format {form} 1.0", "comment made by hand"]
    columns: list[Any] = [(kind, name, vertices[:, k]) for k, name in enumerate("xyz")]
    tell: tuple[str, ...] = ()
    wedge = False
    color: F64 = np.full((len(vertices), 3), 0.5)
    what = d.pick(("texture", "texture", "color", "color", "plain"))
    if what == "texture":
        name = d.pick(("map.png", "my map.png"), "TextureFile")
        header.append(f"comment TextureFile {name}")
        (folder / name).write_bytes(encoded(codes))
        texture = linear(codes / 255.0)
        if d.chance(0.15, "image removed"):
            (folder / name).unlink()
            tell = (name,)
        wedge = d.chance(0.4, "coordinates of corners")
        if not wedge:
            names = d.pick((("s", "t"), ("u", "v"), ("texture_u", "texture_v")), "coordinates")
            columns += [(kind, name, uv[:, k]) for k, name in enumerate(names)]
    elif what == "color":
        whole = rng.integers(0, 256, (len(vertices), 3))
        named = d.pick(("uchar", "float"), "colors of type")
        color = (
            linear(whole / 255.0) if named == "uchar" else (whole / 255.0).astype(np.float32).astype(float)
        )
        values = whole if named == "uchar" else whole / 255.0
        columns += [(named, name, values[:, k]) for k, name in enumerate(("red", "green", "blue"))]
        if d.chance(0.3):
            columns.append((named, "alpha", np.full(len(vertices), 255 if named == "uchar" else 1.0)))
        tell = ("vertex color", "colors of")
    if d.chance(0.3, "a property more"):
        columns.insert(int(rng.integers(len(columns))), ("short", "quality", np.arange(len(vertices))))
    count = d.pick((len(faces), 300_000_000, 2**31 - 1), "claimed faces") if d.chance(0.1) else len(faces)
    header += [f"element vertex {len(vertices)}", *(f"property {t} {n}" for t, n, _ in columns)]
    header += [
        f"element face {count}",
        f"property list uchar {d.pick(('int', 'uint', 'ushort'), 'index')} vertex_indices",
    ]
    index = header[-1].split()[3]
    if wedge:
        header.append("property list uchar float texcoord")
    if d.chance(0.2, "an element more"):
        header += ["element edge 0", "property int a"]
    header.append("end_header")
    refuse = count != len(faces)
    if d.chance(0.15):
        how = d.pick(("NaN", "index 99", "no faces"), "broken:")
        refuse = True
        if how == "NaN":
            columns[[c[1] for c in columns].index("x")][2][5] = np.nan
        elif how == "index 99":
            faces = faces.copy()
            faces[3, 1] = 99
        else:
            header[header.index(f"element face {count}")] = "element face 0"
            faces = faces[:0]
    body = _body(form, columns, faces, index, uv if wedge else None)
    path = folder / "tile.ply"
    path.write_bytes("\n".join(header).encode() + b"\n" + body)
    vertices, faces = patch_of(columns, vertices), faces
    expected: list[Any] = []
    for x, y in PLACES if not refuse else ():
        number, weights, z = hit(vertices, faces, x, y) or (0, np.ones(3), 0.0)
        value = weights @ color[faces[number]]
        if texture is not None:
            u, v = weights @ uv[faces[number]]
            value = looked_up(texture, u, v, _REPEAT)
        expected.append((z - vertices[:, 2].max(), value, {}))
    unless = what == "color"
    right = lambda tile: agree(tile, expected)  # noqa: E731
    return Case(path, ", ".join(d.words), right, refuse, tell, unless, not refuse and (unless or not tell))


def patch_of(columns: list[tuple[str, str, Any]], vertices: F64) -> F64:
    """Positions as they are written."""
    return np.stack([c[2] for c in columns if c[1] in "xyz"], axis=1) if vertices.size else vertices


def _body(form: str, columns: list[tuple[str, str, Any]], faces: Any, index: str, uv: F64 | None) -> bytes:
    codes = {"float": "f", "double": "d", "short": "h", "uchar": "B", "int": "i", "uint": "I", "ushort": "H"}
    order = ">" if "big" in form else "<"
    text: list[str] = []
    out = b""
    for row in zip(*(c[2] for c in columns), strict=True):
        whole = [
            int(v) if c[0] in ("short", "uchar") else float(v) for c, v in zip(columns, row, strict=True)
        ]
        text.append(" ".join(f"{v:.9g}" for v in whole))
        out += struct.pack(order + "".join(codes[c[0]] for c in columns), *whole)
    for face in faces:
        pairs = [] if uv is None else uv[np.minimum(face, len(uv) - 1)].ravel().tolist()
        text.append(
            f"3 {' '.join(map(str, face))}" + (f" 6 {' '.join(f'{p:.9g}' for p in pairs)}" if pairs else "")
        )
        out += struct.pack(f"{order}B3{codes[index]}", 3, *map(int, face))
        out += struct.pack(f"{order}B6f", 6, *pairs) if pairs else b""
    return ("\n".join(text) + "\n").encode() if form == "ascii" else out


def damage(rng: Rng, folder: Path) -> Case:
    """A PLY or OBJ with damaged bytes; what is read is compared with trimesh where that reads it."""
    d = Draws(rng)
    case = d.pick((ply, ply, obj))(rng, folder)
    case.path.write_bytes(damaged(case.path.read_bytes(), d))
    return Case(case.path, f"{case.text}; {', '.join(d.words)}", lambda tile: _same_geometry(tile, case.path))


def _same_geometry(tile: Any, path: Path) -> bool | None:
    """Whether the area of the triangles is that of trimesh's reading; None where that fails."""
    import trimesh

    try:
        mesh: Any = trimesh.load(path, process=False, force="mesh", skip_materials=True)
        width = np.ptp(mesh.vertices[np.unique(mesh.faces)][:, 0])
        area = float(mesh.area) / width**2
    except Exception:
        return None
    a, b, c = (tile.vertices[tile.faces[:, k]] for k in range(3))
    own = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)
    return True if abs(own - area) < 1e-3 * max(own, 1e-9) else None
