"""Makes docs/pictures/curved.png: displaced surfaces, path-traced, beside a fitted material on smooth ones.

From the repository's root: ``.venv/bin/python docs/pictures/make_curved_picture.py``. It generates data of
``twisted_wool`` and fits them into ``out/curved/`` first, in some minutes. Columns: Mitsuba's path tracer on
the displaced surface (``mbtf-gen reference --surface``), the material with silhouettes, and without. Printed,
of the material against the path-traced picture: mean, RMS difference of blocks of 16 x 16 pixels over the
mean, both of blocks that show the object, and mean distance of the outlines in pixels.

``spot.ply`` is Spot by Keenan Crane, in the public domain.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import binary_erosion, distance_transform_edt

from mbtf_core.color import to_display
from mbtf_core.directions import from_angles
from mbtf_core.pictures import Camera
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.engine.runtime import load_mitsuba

ROOT = Path(__file__).parents[2]
OUT = ROOT / "out" / "curved"
SIZE, SPP, EXPOSURE = 288, 32, 2.3
MESH = 128
# Elevation and azimuth of view and light, by surface.
DIRECTIONS = {
    "sphere": ((20.0, -90.0), (40.0, -40.0)),
    "spot": ((12.0, 130.0), (40.0, 180.0)),
    "cloth": ((10.0, -105.0), (40.0, -25.0)),
}
TILES = {"sphere": 13, "spot": 16.0, "cloth": 5.0}


def fitted() -> Path:
    """The fitted material, made where it is missing."""
    for folder, words in {
        "shards": f"mbtf_gen assets/twisted_wool --resolution 64 --mesh {MESH} --queries 800/texel --spp 16",
        "material": f"mbtf_fit {OUT}/shards --steps 6000 --set network.width=32"
        " --set network.relief.places=2",
    }.items():
        print("python -m", words, f"-o {OUT / folder}", flush=True)
        command = [sys.executable, "-m", *words.split(), "-o", str(OUT / folder), "--quiet"]
        subprocess.run(command, check=True, cwd=ROOT)
    return OUT / "material"


def hanging_cloth() -> Path:
    """A sheet whose folds deepen downwards, as a mesh; its texture coordinates are lengths along it."""
    n, across, down = 121, 2.4, 2.0
    x, z = np.meshgrid(np.linspace(0, across, n), np.linspace(0, -down, n))
    y = 0.06 * (0.4 - z) * np.sin(6.5 * x + 0.5 * np.sin(1.5 * z))
    step = np.hypot(np.diff(x, axis=1), np.diff(y, axis=1))
    along = np.concatenate([np.zeros((n, 1)), np.cumsum(step, 1)], 1)
    number = np.arange(1, n * n + 1).reshape(n, n)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    lines = [f"v {i:.6f} {j:.6f} {k:.6f}" for i, j, k in zip(x.flat, y.flat, z.flat, strict=True)]
    lines += [f"vt {u:.6f} {v:.6f}" for u, v in zip(along.flat, z.flat, strict=True)]
    lines += ["f " + " ".join(f"{k}/{k}" for k in face) for face in faces]
    path = OUT / "cloth.obj"
    path.write_text("\n".join(lines) + "\n")
    return path


def blocks(image: Any) -> NDArray[np.float64]:
    """Means of 16 x 16 pixels."""
    gray = image.value.mean(-1).astype(np.float64)
    return gray.reshape(SIZE // 16, 16, SIZE // 16, 16).mean((1, 3))


def outline_distance(a: Any, b: Any) -> float:
    """Mean distance of the outlines of two pictures in pixels."""
    inside = [image.transmittance < 0.5 for image in (a, b)]
    lines = [mask & ~binary_erosion(mask) for mask in inside]
    return float(np.mean([distance_transform_edt(~x)[y].mean() for x, y in (lines, lines[::-1])]))


def main() -> None:
    """Write the picture."""
    material = fitted()
    load_mitsuba()
    import mbtf_fit.backends.mitsuba
    from mbtf_gen.job import Job
    from mbtf_gen.pictures.displaced_mesh import DisplacedMesh
    from mbtf_gen.pictures.shapes import Chart, render_scene, render_shape, shape_scene

    mbtf_fit.backends.mitsuba.register()
    job = Job.load(GeneratorConfig(material=str(ROOT / "assets/twisted_wool"), geometry={"mesh": MESH}))
    files = {"spot": Path(__file__).with_name("spot.ply"), "cloth": hanging_cloth()}
    surfaces: dict[str, Chart | DisplacedMesh] = {"sphere": Chart("sphere", int(TILES["sphere"]), 1.0)}
    for name, path in files.items():
        surfaces[name] = DisplacedMesh.read(path, TILES[name], 1.0, "y" if name == "spot" else "z")
    cameras = {
        name: Camera(*DIRECTIONS[name][0], 2.16 * surface.radius, rows=SIZE, columns=SIZE)
        for name, surface in surfaces.items()
    }
    lights = {name: from_angles(*light) for name, (_, light) in DIRECTIONS.items()}
    # First, as Mitsuba's path tracer would compile materials that are loaded.
    references = {s: render_shape(job, surfaces[s].mesh, cameras[s], lights[s], SPP) for s in surfaces}
    rows = []
    for name, surface in surfaces.items():
        expected = references[name]
        pictures, seen = [expected], blocks(expected) > 0
        for silhouettes in (True, False):
            bsdf = {"type": "mbtf", "material": str(material), "silhouettes": silhouettes}
            scene = shape_scene(surface.mesh(None, bsdf), cameras[name], lights[name], {"type": "mbtf_path"})
            found = render_scene(scene, SPP, [1])
            pictures.append(found)
            rms = np.sqrt(((blocks(found) - blocks(expected))[seen] ** 2).mean())
            print(
                f"{name}, {'with' if silhouettes else 'without'} silhouettes: mean "
                f"{found.value.mean() / expected.value.mean():.3f}, RMS of blocks "
                f"{rms / blocks(expected)[seen].mean():.1%}, outlines "
                f"{outline_distance(expected, found):.2f} pixels apart",
                flush=True,
            )
        # Without the empty space above and below.
        full = np.flatnonzero((expected.transmittance < 0.5).any(1))
        cut = slice(max(0, full[0] - 6), full[-1] + 7)
        white = [p.value + p.transmittance[..., None] for p in pictures]
        rows.append(np.concatenate([picture[cut] for picture in white], 1))
    Image.fromarray(to_display(np.concatenate(rows), EXPOSURE)).save(
        Path(__file__).with_name("curved.png"), optimize=True
    )


if __name__ == "__main__":
    main()
