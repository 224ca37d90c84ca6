"""OBJ with materials, and PLY, written from their descriptions."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from mutations.case import Case, Draws, Look, encoded, linear, patch, quarters

# Statements of materials that may be used or not, and words of the warning.
_OPTIONAL = {
    "Ke 1 0 0": ("ke", "emi"),
    "map_Bump gray.png": ("bump", "normal"),
    "map_d gray.png": ("map_d", "opacity", "transparen"),
    "d 0.3": ("'d'", " d ", "d 0.3", "opacity", "opaque", "transparen"),
}


def obj(d: Draws, folder: Path) -> Case:
    """A bumpy tile, z up, with a material file; colors of vertices are sRGB, as in most files."""
    vertices, faces = patch(d.rng)
    look = Look(vertices, faces, vertices[:, :2] * d.pick((1.0, 2.0, -1.0)) + d.pick((0.0, 0.25, -3.0)))
    form = d.pick(("v/vt", "v/vt/vn", "negative", "squares"), "form")
    if form == "squares":  # no two readers need to agree on the diagonals of bent ones
        vertices[:, 2] = 0.0
    look.factor = np.array([d.between(0, 1), d.between(0, 1), d.between(0, 0.05)])
    mtl = ["# a comment", "newmtl other", "Kd 0.1 0.2 0.3", "newmtl m", ""]
    tell: tuple[str, ...] = ()
    unless = False
    codes = quarters(d.rng)
    (folder / "gray.png").write_bytes(encoded(codes[..., 0]))
    if d.chance(0.6):
        name = d.pick(("map.png", "my map.png", "sub/map.png"), "map")
        (folder / "sub").mkdir()
        (folder / name).write_bytes(encoded(codes))
        look.texture = linear(codes / 255.0)
        if d.chance(0.5, "Kd 1"):
            look.factor = np.ones(3)
        options = ""
        if d.chance(0.4):
            s, o = d.rng.uniform(0.5, 4, 2).round(2), d.rng.uniform(-1, 1, 2).round(2)
            options, look.to_uv = f"-s {s[0]} {s[1]} 1 -o {o[0]} {o[1]} 0 ", np.column_stack([np.diag(s), o])
        if d.chance(0.2):
            options, look.wrap = options + "-clamp on ", ("clamp", "clamp")
        if name == "sub/map.png":
            name = d.pick((name, "sub\\map.png", "C:\\Users\\me\\sub\\map.png", "Sub/MAP.png"), "written")
        mtl.append(f"map_Kd {options}{name}")
        d.words.append(options)
        if d.chance(0.1, "image removed"):
            next(folder.rglob("*map.png")).unlink()
            tell = ("map.png",)
    elif d.chance(0.4, "vertex colors"):
        colors = d.rng.uniform(0, 1, (len(vertices), 3)).round(3)
        look.colors, tell, unless = linear(colors), ("vertex color", "colors of"), True
    if not tell and d.chance(0.25):
        mtl.append(d.pick(_OPTIONAL, "with"))
        tell, unless = _OPTIONAL[mtl[-1]], "d" in mtl[-1].split()[0].split("_")
        if unless:
            look.more = {"opacity": codes[..., :1] / 255.0 if "map_d" in mtl[-1] else 0.3}
    how = d.fault(0.2, "index 99", "f 0 1 2", "no mtl", "Kd 1e9 0 0", "Kd nan 0 0", "ghost", "v nan 0 0")
    mtl[4] = how if how.startswith("Kd") else "Kd {} {} {}".format(*look.factor)
    rows = np.column_stack([vertices] if look.colors is None else [vertices, colors])
    lines = ["mtllib my tile.mtl", "o tile"]
    lines += ["v " + " ".join(f"{number:g}" for number in row) for row in rows]
    lines += [f"vt {u:g} {v:g}" for u, v in look.uv]
    lines += ["vn 0 0 1", "usemtl m", "s 1"]
    if how == "ghost":
        lines.append("usemtl ghost")
    if form == "squares":
        faces = np.array([[i, i + 1, i + 5, i + 4] for i in range(11) if i % 4 < 3])
    numbers = faces - len(vertices) if form == "negative" else faces + 1
    pattern = "{0}/{0}/1" if form == "v/vt/vn" else "{0}/{0}"
    lines += ["f " + " ".join(pattern.format(i) for i in face) for face in numbers]
    if how == "index 99":
        lines.append("f 99/1 1/1 2/2")
    elif how == "v nan 0 0":
        lines[2] = how
    elif how == "f 0 1 2":
        lines.append(how)
    if how in ("ghost", "no mtl"):
        tell, unless = (how, ".mtl"), False
    (folder / "tile.obj").write_text("\n".join(lines) + "\n")
    if how != "no mtl":
        (folder / "my tile.mtl").write_text("\n".join(mtl) + "\n")
    refuse = how not in ("", "ghost", "no mtl")
    valid = not how and (unless or not tell)
    return Case(folder / "tile.obj", look.is_read_as, refuse, tell, unless, valid)


_CODES = {"float": "f", "double": "d", "short": "h", "uchar": "B", "int": "i", "uint": "I", "ushort": "H"}


def ply(d: Draws, folder: Path) -> Case:
    """A bumpy tile, z up, in text or binary, with texture coordinates of vertices or of corners."""
    vertices, faces = patch(d.rng)
    look = Look(vertices, faces, vertices[:, :2].copy(), factor=np.full(3, 0.5))
    form = d.pick(("ascii", "binary_little_endian", "binary_big_endian"), "form")
    header = ["ply", f"format {form} 1.0", "comment made by hand"]
    kind = d.pick(("float", "double"))
    stored: Any = vertices
    columns: list[Any] = [(kind, name, vertices[:, k]) for k, name in enumerate("xyz")]
    tell: tuple[str, ...] = ()
    corners = False
    what = d.pick(("texture", "texture", "color", "color", "plain"))
    if what == "texture":
        codes, name = quarters(d.rng), d.pick(("map.png", "my map.png"), "TextureFile")
        header.append(f"comment TextureFile {name}")
        look.texture, look.factor = linear(codes / 255.0), np.ones(3)
        if d.chance(0.15, "image removed"):
            tell = (name,)
        else:
            (folder / name).write_bytes(encoded(codes))
        corners = d.chance(0.4, "coordinates of corners")
        if not corners:
            names = d.pick((("s", "t"), ("u", "v"), ("texture_u", "texture_v")), "coordinates")
            columns += [(kind, name, look.uv[:, k]) for k, name in enumerate(names)]
    elif what == "color":
        whole, look.factor = d.rng.integers(0, 256, (len(vertices), 3)), np.ones(3)
        if d.chance(0.5, "8-bit colors"):
            look.colors, kind, stored = linear(whole / 255.0), "uchar", whole
        else:
            look.colors, kind, stored = whole / 255.0, "float", whole / 255.0
        columns += [(kind, name, stored[:, k]) for k, name in enumerate(("red", "green", "blue"))]
        tell = ("vertex color", "colors of")
    if d.chance(0.3, "a property more"):
        columns.insert(int(d.rng.integers(len(columns))), ("short", "quality", np.arange(len(vertices))))
    how = d.fault(0.2, "300000000", "2147483647", "NaN", "index 99", "no faces")
    if how == "NaN":
        vertices[5, 0] = np.nan
    elif how == "index 99":
        faces[3, 1] = 99
    elif how == "no faces":
        faces = faces[:0]
    index = d.pick(("int", "uint", "ushort"), "index")
    header += [f"element vertex {len(vertices)}", *(f"property {t} {n}" for t, n, _ in columns)]
    header.append(f"element face {how if how.isdigit() else len(faces)}")
    header.append(f"property list uchar {index} vertex_indices")
    if corners:
        header.append("property list uchar float texcoord")
    if d.chance(0.2, "an element more"):
        header += ["element edge 0", "property int a"]
    # Rows of (code, number), as text or packed.
    rows = [[(_CODES[t], array[i]) for t, _, array in columns] for i in range(len(vertices))]
    for face in faces:
        rows.append([("B", 3), *((_CODES[index], i) for i in face)])
        if corners:
            rows[-1] += [("B", 6), *(("f", x) for i in face for x in look.uv[min(i, 15)])]
    if form == "ascii":
        body = "".join(" ".join(f"{x:.9g}" for _, x in row) + "\n" for row in rows).encode()
    else:
        order = ">" if "big" in form else "<"
        body = b"".join(
            struct.pack(order + code, x if code in "fd" else int(x)) for row in rows for code, x in row
        )
    path = folder / "tile.ply"
    path.write_bytes("\n".join([*header, "end_header"]).encode() + b"\n" + body)
    unless = what == "color"
    return Case(path, look.is_read_as, bool(how), tell, unless, not how and (unless or not tell))
