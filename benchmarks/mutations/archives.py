"""Measured BTFs: photographs in archives, DFMF files (.btf), and HDF5 of two programs."""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from mutations.case import F64, Case, Draws, encoded, linear
from mutations.images import png

SUFFIXES = (".zip", ".btf", ".hdf5", ".photographs")


def read(path: Path) -> F64:
    """Light, viewer and value (n, 9) of all texels of each pair, as our reader reads them."""
    from mbtf_gen.measured.open import open_measured

    found: Any = open_measured(path)
    if hasattr(found, "count"):
        block = found.read(0, found.count)
        return np.column_stack([block["omega_i"], block["omega_o"], block["value"]])
    texels = found.rows * found.columns
    pairs = np.repeat(np.arange(len(found.light)), texels)
    values = found.values(pairs, np.tile(np.arange(texels), len(found.light)))
    return np.column_stack([found.light[pairs], found.view[pairs], values])


def _case(path: Path, light: F64, view: F64, values: Any, how: str, near: float, refuse: bool = True) -> Case:
    """Light and viewer (n, 3) of pairs, and the values (n, texels, 3) of each, in any order of the pairs."""
    texels = np.size(values) // (3 * len(light))
    directions = np.repeat(np.column_stack([light, view]), texels, axis=0)
    wanted = np.column_stack([directions, np.reshape(values, (-1, 3))])

    def check(found: F64) -> bool:
        if found.shape != wanted.shape:
            return False
        # Texels of one pair keep their order.
        order = [np.lexsort(np.round(rows[:, 5::-1], 3).T + 0.0) for rows in (found, wanted)]
        return bool(np.abs(found[order[0]] - wanted[order[1]]).max() <= near)

    return Case(path, check, bool(how) and refuse, valid=not how)


def _unit(angles: Any) -> F64:
    """Directions (n, 3) of polar angles and azimuths in degrees."""
    t, p = np.deg2rad(angles).T
    return np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=-1)


def make(d: Draws, folder: Path) -> Case:
    """One of the kinds, with variations of what writers do and faults."""
    maker = d.pick((_photographs, _factors, _hdf5, _hdf5))
    return maker(d, folder)


def _photographs(d: Draws, folder: Path) -> Case:
    """UBO2003: names hold the angles; 8-bit sRGB."""
    angles = [((tl, pl), (tv, pv)) for tl, pl in ((0, 0), (30, 60)) for tv, pv in ((15, 90), (45, 300))]
    how = d.fault(0.35, "twice", "other size", "names", "text inside", "alpha", "16-bit")
    folders = "tv{3:03d}_pv{4:03d}/" if d.chance(0.3, "in folders") else "{0:05d}_"
    form = folders + d.pick("_ ", "between").join(("tl{1:03d}", "pl{2:03d}", "tv{3:03d}", "pv{4:03d}"))
    kind = d.pick(("PNG", "JPEG"), "images") if how not in ("alpha", "16-bit") else "PNG"
    files: dict[str, bytes] = {}
    images = []
    for number, (light, view) in enumerate([*angles, ((0, 0), (95, 10))]):  # the last is not a reflection
        codes = np.kron(d.rng.integers(0, 256, (2, 2, 3)), np.ones((8, 8, 1))).astype(np.uint8)
        codes = np.repeat(codes[..., :1], 3, axis=-1) if kind == "JPEG" else codes
        images.append(linear(codes / 255.0))
        name = form.format(number, *light, *view) + (".jpg" if kind == "JPEG" else ".png")
        name = f"image{number}.png" if how == "names" else name
        shown = codes[:8] if how == "other size" and number == 1 else codes
        shown = np.concatenate([codes, codes[..., :1] // 2], axis=-1) if how == "alpha" else shown
        files[name] = png(codes.astype(int) * 257, 2, 16) if how == "16-bit" else encoded(shown, kind)
        files[name] = b"no image" if how == "text inside" and number == 1 else files[name]
    if how == "twice":
        files["more/" + next(iter(files)).rsplit("/", 1)[-1]] = list(files.values())[1]
    if d.chance(0.3, "other files"):
        files |= dict.fromkeys(("readme.txt", "__MACOSX/._x.jpg", "Thumbs.db"), b"x")
        files["calibration.png"] = encoded(np.zeros((4, 4, 3), np.uint8))
    above = "MATERIAL/" if d.chance(0.3, "a folder above") else ""
    path = folder / ("m.photographs" if d.chance(0.3, "unpacked") else "m.zip")
    for name, content in files.items():
        if path.suffix == ".zip":
            with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
                archive.writestr(above + name, content)
        else:
            (path / above / name).parent.mkdir(parents=True, exist_ok=True)
            (path / above / name).write_bytes(content)
    lights, views = (_unit(a) for a in zip(*angles, strict=True))
    return _case(path, lights, views, images[:-1], how, 0.02, how not in ("alpha", "16-bit"))


def _factors(d: Draws, folder: Path) -> Case:
    """A DFMF file of values in linear RGB, of as many components as it takes; pairs are view by view."""
    lights, views = [(0, 0), (40, 70)], [(20, 10), (50, 200), (70, 300)]
    rows, columns, many = 3, 4, 300_000_000
    grid = np.round(d.rng.uniform(0, 1, (len(views) * len(lights), rows * columns, 3)), 3)
    width, version = d.pick((4, 8), "width"), d.pick((1, 2, 3, 4), "version")
    how = d.fault(0.4, "views", "columns", "components", "NaN", "angle 9", "model 77", "cut", "longer")
    meta = bytes(240) + struct.pack("<4f", 1, 1, 1, 1)
    meta += struct.pack("<I", 1) * (version > 1) + struct.pack("<I6s", 6, b"<xml/>") * (version > 2)
    meta += (struct.pack("<I", 3) + b"".join(b"\1\0\0\0" + c for c in (b"R", b"G", b"B"))) * (version > 3)
    out = b"!DFMF08FCR" + struct.pack("<II", 8 + len(meta), version) + meta
    out += struct.pack("<I", many if how == "views" else len(views))
    for number, angles in enumerate(views):
        stored = np.deg2rad(angles)
        if number == 1 and how in ("NaN", "angle 9"):
            stored[0] = np.nan if how == "NaN" else 9.0
        out += stored.astype("<f4").tobytes() + struct.pack("<I", len(lights))
        out += np.deg2rad(lights).astype("<f4").tobytes()
    out += struct.pack("<III", many if how == "columns" else columns, rows, 0)
    out += struct.pack("<Ii", 6, 77 if how == "model 77" else 0) + bytes(48)
    for channel in np.moveaxis(grid, -1, 0):
        u, s, v = np.linalg.svd(channel, full_matrices=False)
        out += struct.pack("<BIII", width, many if how == "components" else len(s), *channel.shape)
        out += b"".join(a.astype(f"<f{width}").tobytes() for a in (s, u, v.T * s))
    out = out[: int(len(out) * d.between(0.1, 0.99))] if how == "cut" else out + b"abc" * (how == "longer")
    (folder / "m.btf").write_bytes(out)
    view, light = np.repeat(_unit(views), len(lights), axis=0), np.tile(_unit(lights), (len(views), 1))
    return _case(folder / "m.btf", light, view, grid, how, 1e-3)


def _hdf5(d: Draws, folder: Path) -> Case:
    """Images with a direction each of light and viewer (NeuralBTF), or unrelated queries (NeuMIP), whose
    directions are those in which the camera looks and the light travels."""
    import h5py

    queries = d.chance(0.5, "queries")
    n = 24 if queries else 3
    angles = d.rng.uniform((0, 0), (78, 360), (2, n, 2))
    light, view = map(_unit, angles)
    color = d.rng.uniform(0, 1, (n, 3) if queries else (n, 4, 5, 3)).astype("f4")
    stored = {"ground_light": light[:, :2], "ground_camera_dir": view[:, :2], "ground_color": color}
    if queries:
        stored = {k: a.reshape(2, 3, 4, -1) * (1 if "color" in k else -1) for k, a in stored.items()}
        stored["ground_camera_target_loc"] = d.rng.uniform(-1, 1, (2, 3, 4, 2))
        stored["ground_camera_query_radius"] = d.rng.uniform(0.01, 0.1, (2, 3, 4, 1))
    how = d.fault(0.3, "claims 3e8", "missing", "text", "long direction", "other shape")
    name = "ground_light" if how == "long direction" else d.pick(stored, "in")
    options = d.pick(({}, {"compression": "gzip"}, {"compression": "lzf"}, {"chunks": True}), "with")
    kind = d.pick(("f4", "f8"))
    with h5py.File(folder / "m.hdf5", "w") as file:
        for key, array in stored.items():
            hurt = how if key == name else ""
            if hurt == "claims 3e8":
                shape = array.shape[1:]
                file.create_dataset(key, (300_000_000, *shape), kind, chunks=(1, *shape))
            elif hurt == "text":
                file.create_dataset(key, data=np.full(array.shape, b"x"))
            elif hurt != "missing":
                array = array[:1] if hurt == "other shape" else array * (1.7 if hurt else 1)
                file.create_dataset(key, data=array.astype(kind), **options)
    case = _case(folder / "m.hdf5", light, view, color, how, 2e-3, how != "long direction")
    # Queries with a direction longer than 1 are left out, which the import reports.
    return Case(case.path) if how == "long direction" and queries else case
