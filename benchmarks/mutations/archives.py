"""Measured BTFs: photographs in archives, DFMF files (.btf), and HDF5 of two programs."""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from mutations.case import F64, Case, Draws, Rng, damaged, encoded, linear

SUFFIXES = (".zip", ".btf", ".hdf5", ".photographs")


def values(path: Path) -> tuple[F64, F64, F64]:
    """(values, light, viewer), (n, 3) each, as our reader reads them: all texels of each pair."""
    from mbtf_gen.measured.open import open_measured

    found: Any = open_measured(path)
    if hasattr(found, "count"):
        block = found.read(0, found.count)
        return block["value"], block["omega_i"], block["omega_o"]
    texels = found.rows * found.columns
    pairs = np.repeat(np.arange(len(found.light)), texels)
    read = found.values(pairs, np.tile(np.arange(texels), len(found.light)))
    return read, found.light[pairs], found.view[pairs]


def _unit(theta: Any, phi: Any) -> F64:
    t, p = np.deg2rad(theta), np.deg2rad(phi)
    return np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=-1)


def _agree(read: tuple[F64, F64, F64], wanted: F64, light: F64, view: F64, tolerance: float) -> bool:
    """Whether all values are there with their directions, in any order of the pairs."""
    if len(read[0]) != len(wanted):
        return False
    rows = [np.column_stack([light, view, wanted]), np.column_stack([read[1], read[2], read[0]])]
    keys = [np.round(r[:, :6], 3) + 0.0 for r in rows]
    order = [np.lexsort(np.column_stack([np.arange(len(k)), k]).T[::-1][::-1][:0:-1]) for k in keys]
    return bool(np.abs(rows[0][order[0]] - rows[1][order[1]]).max() <= tolerance)


def make(rng: Rng, folder: Path) -> Case:
    """One of the kinds, with variations of what writers do and faults."""
    return [_photographs, _factors, _neural, _queries][int(rng.integers(4))](Draws(rng), folder)


def _photographs(d: Draws, folder: Path) -> Case:
    """UBO2003: names hold the angles; 8-bit sRGB."""
    rng = d.rng
    angles = [(tl, pl, tv, pv) for tl, pl in ((0, 0), (30, 60)) for tv, pv in ((15, 90), (45, 300), (95, 10))]
    how = (
        d.pick(("twice", "other size", "names", "HTML", "text inside", "alpha", "16-bit"))
        if d.chance(0.35)
        else ""
    )
    d.words.append(how)
    form = d.pick(
        (
            "{:05d} tl{:03d} pl{:03d} tv{:03d} pv{:03d}",
            "{:05d}_tl{:03d}_pl{:03d}_tv{:03d}_pv{:03d}",
            "tv{3:03d}_pv{4:03d}/tl{1:03d}_pl{2:03d}_tv{3:03d}_pv{4:03d}",
        )
    )
    kind = d.pick(("PNG", "JPEG"))
    files: dict[str, bytes] = {}
    wanted, light, view = [], [], []
    for number, (tl, pl, tv, pv) in enumerate(angles):
        codes = np.kron(rng.integers(0, 256, (2, 2, 3)), np.ones((8, 8, 1))).astype(np.uint8)
        if kind == "JPEG":
            codes[..., :] = codes[..., :1]
        name = form.format(number, tl, pl, tv, pv) + (".jpg" if kind == "JPEG" else ".png")
        name = f"image{number}.png" if how == "names" else name
        shown = codes[:8] if how == "other size" and number == 1 else codes
        if how == "alpha":
            shown = np.concatenate([codes, codes[..., :1] // 2], axis=-1)
        files[name] = encoded(
            shown,
            kind if how != "alpha" else "PNG",
            **({"quality": 100} if kind == "JPEG" and how != "alpha" else {}),
        )
        if how == "text inside" and number == 1:
            files[name] = b"no image"
        if how == "16-bit":
            from mutations.textures import png

            files[name] = png(codes.astype(int) * 257, 2, 16)
        if tv < 90:
            wanted.append(linear(codes.reshape(-1, 3) / 255.0))
            light.append(np.tile(_unit(tl, pl), (256, 1)))
            view.append(np.tile(_unit(tv, pv), (256, 1)))
    if how == "twice":
        files["more/" + next(iter(files)).rsplit("/", 1)[-1]] = list(files.values())[1]
    if d.chance(0.3, "other files"):
        files |= {
            "readme.txt": b"x",
            "__MACOSX/._x.jpg": b"x",
            "Thumbs.db": b"x",
            "calibration.png": encoded(np.zeros((4, 4, 3), np.uint8)),
        }
    if d.chance(0.3, "a folder above"):
        files = {f"MATERIAL/{name}": content for name, content in files.items()}
    if d.chance(0.3, "unpacked"):
        path = folder / "m.photographs"
        for name, content in files.items():
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            (path / name).write_bytes(content)
    else:
        path = folder / "m.zip"
        with zipfile.ZipFile(path, "w", d.pick((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
            for name, content in files.items():
                archive.writestr(name, content)
        if how == "HTML":
            path.write_bytes(b"<!DOCTYPE html><html>quota exceeded</html>")
    refuse = how in ("twice", "other size", "names", "HTML", "text inside") and not (
        how == "HTML" and path.is_dir()
    )
    table, lights, views = (np.concatenate(a) for a in (wanted, light, view))
    right = lambda read: _agree(read, table, lights, views, 0.02)  # noqa: E731
    return Case(path, ", ".join(d.words), right, refuse, valid=not how)


def _factors(d: Draws, folder: Path) -> Case:
    """A DFMF file of values in linear RGB, of as many components as it takes."""
    rng = d.rng
    lights, views = [(0, 0), (40, 70)], [(20, 10), (50, 200), (70, 300)]
    rows, columns = 3, 4
    grid = np.round(rng.uniform(0, 1, (len(views) * len(lights), rows * columns, 3)), 3)
    width, version = d.pick((4, 8)), d.pick((1, 2, 3, 4), "version")
    how = (
        d.pick(
            (
                "views 3e8",
                "columns 3e8",
                "components 3e8",
                "NaN",
                "angle 9",
                "model 77",
                "cut",
                "longer",
                "no angle",
            )
        )
        if d.chance(0.4)
        else ""
    )
    d.words.append(how)
    meta = bytes(240) + struct.pack("<4f", 1, 1, 1, 1)
    meta += struct.pack("<I", 1) if version > 1 else b""
    meta += struct.pack("<I", 6) + b"<xml/>" if version > 2 else b""
    meta += (
        struct.pack("<I", 3) + b"".join(struct.pack("<I", 1) + c for c in (b"R", b"G", b"B"))
        if version > 3
        else b""
    )
    out = b"!DFMF08FCR" + struct.pack("<II", 8 + len(meta), version) + meta
    out += struct.pack("<I", 300_000_000 if how == "views 3e8" else len(views))
    for number, angles in enumerate(views):
        stored = np.deg2rad(angles)
        if number == 1 and how in ("NaN", "angle 9", "no angle"):
            stored = np.array({"NaN": [np.nan, 0], "angle 9": [9.0, 0], "no angle": [np.inf, 0]}[how])
        out += (
            stored.astype("<f4").tobytes()
            + struct.pack("<I", len(lights))
            + np.deg2rad(lights).astype("<f4").tobytes()
        )
    out += struct.pack("<III", 300_000_000 if how == "columns 3e8" else columns, rows, 0)
    out += struct.pack("<Ii", 6, 77 if how == "model 77" else 0) + bytes(48)
    for channel in range(3):
        u, s, v = np.linalg.svd(grid[..., channel], full_matrices=False)
        out += struct.pack(
            "<BIII", width, 300_000_000 if how == "components 3e8" else len(s), *grid.shape[:2]
        )
        out += b"".join(a.astype(f"<f{width}").tobytes() for a in (s, u, v.T * s))
    out = (
        out[: int(len(out) * d.number(0.1, 0.99))]
        if how == "cut"
        else out + b"abc"
        if how == "longer"
        else out
    )
    path = folder / "m.btf"
    path.write_bytes(out)
    # Row 0 is the top; pairs are view by view.
    light = np.concatenate(
        [np.repeat(_unit(*zip(*lights, strict=True)), rows * columns, axis=0)] * len(views)
    )
    view = np.repeat(_unit(*zip(*views, strict=True)), len(lights) * rows * columns, axis=0)
    return Case(
        path,
        ", ".join(d.words),
        lambda read: _agree(read, grid.reshape(-1, 3), light, view, 1e-3),
        bool(how),
        valid=not how,
    )


def _directions(rng: Rng, count: int) -> F64:
    theta, phi = np.arccos(rng.uniform(0.2, 1, count)), rng.uniform(-np.pi, np.pi, count)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


def _neural(d: Draws, folder: Path) -> Case:
    """NeuralBTF: images (N, H, W, 3) with a direction each of light and viewer."""
    rng, n = d.rng, 3
    light, view, color = (
        _directions(rng, n),
        _directions(rng, n),
        rng.uniform(0, 1, (n, 4, 5, 3)).astype("f4"),
    )
    stored = {"ground_light": light[:, :2], "ground_camera_dir": view[:, :2], "ground_color": color}
    return _hdf5(d, folder, stored, color.reshape(-1, 3), np.repeat(light, 20, 0), np.repeat(view, 20, 0))


def _queries(d: Draws, folder: Path) -> Case:
    """NeuMIP: unrelated queries; directions are those in which the camera looks and the light travels."""
    rng, shape = d.rng, (2, 3, 4)
    light, view = _directions(rng, 24), _directions(rng, 24)
    color = rng.uniform(0, 1, (24, 3)).astype("f4")
    stored = {
        "ground_light": -light[:, :2].reshape(*shape, 2),
        "ground_camera_dir": -view[:, :2].reshape(*shape, 2),
        "ground_color": color.reshape(*shape, 3),
        "ground_camera_target_loc": rng.uniform(-1, 1, (*shape, 2)),
        "ground_camera_query_radius": rng.uniform(0.01, 0.1, (*shape, 1)),
    }
    return _hdf5(d, folder, stored, color, light, view)


def _hdf5(d: Draws, folder: Path, stored: dict[str, Any], color: F64, light: F64, view: F64) -> Case:
    import h5py

    path = folder / "m.hdf5"
    how = d.pick(("claims 3e8", "missing", "text", "long direction", "other shape")) if d.chance(0.3) else ""
    kind = d.pick(("f4", "f8"))
    options = d.pick(({}, {"compression": "gzip"}, {"compression": "lzf"}, {"chunks": True}))
    name = d.pick(stored, how)
    with h5py.File(path, "w") as file:
        for key, array in stored.items():
            hurt = how if key == (name if how != "long direction" else "ground_light") else ""
            array = np.asarray(array, kind) * (1.7 if hurt == "long direction" else 1)
            if hurt == "claims 3e8":
                file.create_dataset(key, (300_000_000, *array.shape[1:]), kind, chunks=(1, *array.shape[1:]))
            elif hurt == "text":
                file.create_dataset(key, data=np.full(array.shape, b"x"))
            elif hurt == "other shape":
                file.create_dataset(key, data=array[:1])
            elif hurt != "missing":
                file.create_dataset(key, data=array, **options)
    # Queries with a direction longer than 1 are left out, which the import reports.
    undecided = how == "long direction" and len(stored) == 5
    check = (lambda _: None) if undecided else (lambda read: _agree(read, color, light, view, 2e-3))
    return Case(path, ", ".join(d.words), check, bool(how) and how != "long direction", valid=not how)


def damage(rng: Rng, folder: Path) -> Case:
    """Any of these with damaged bytes; values that are read right are."""
    case, d = make(rng, folder), Draws(rng)
    if case.path.is_file():
        case.path.write_bytes(damaged(case.path.read_bytes(), d))
    right = case.check
    return Case(
        case.path,
        f"{case.text}; {', '.join(d.words)}",
        lambda read: True if not case.refuse and right(read) else None,
    )
