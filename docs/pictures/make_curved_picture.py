"""Makes docs/pictures/curved.png: displaced shapes, path-traced, beside a fitted material on smooth ones.

From the repository's root: ``.venv/bin/python docs/pictures/make_curved_picture.py``. It generates data of
``cliff_rock`` and fits them into ``out/curved/`` first, in some minutes. Columns: Mitsuba's path tracer on
the displaced shape (``mbtf-gen reference --surface``), the material with silhouettes, and without. Printed,
of the material against the path-traced picture: mean, RMS difference of blocks of 16 x 16 pixels over the
mean, and mean distance of the outlines in pixels.
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
from mbtf_gen.config.pictures import Shape
from mbtf_gen.engine.runtime import load_mitsuba

ROOT = Path(__file__).parents[2]
OUT = ROOT / "out" / "curved"
SIZE, SPP, EXPOSURE = 320, 64, 2.6
MESH = 128
LIGHT, VIEW = from_angles(40.0, -40.0), (20.0, -90.0)
# Tiles around the equator.
SHAPES: dict[Shape, int] = {"sphere": 13, "torus": 25}


def fitted() -> Path:
    """The fitted material, made where it is missing."""
    for folder, words in {
        "shards": f"mbtf_gen assets/cliff_rock --resolution 64 --mesh {MESH} --queries 200/texel --spp 16",
        "material": f"mbtf_fit {OUT}/shards --time 2min",
    }.items():
        print("python -m", words, f"-o {OUT / folder}", flush=True)
        command = [sys.executable, "-m", *words.split(), "-o", str(OUT / folder), "--quiet"]
        subprocess.run(command, check=True, cwd=ROOT)
    return OUT / "material"


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
    from mbtf_gen.pictures.shapes import Chart, render_scene, render_shape, shape_scene

    mbtf_fit.backends.mitsuba.register()
    job = Job.load(GeneratorConfig(material=str(ROOT / "assets/cliff_rock"), geometry={"mesh": MESH}))
    cameras = {s: Camera(*VIEW, 1.08 * n / np.pi, rows=SIZE, columns=SIZE) for s, n in SHAPES.items()}
    # First, as Mitsuba's path tracer would compile materials that are loaded.
    references = {s: render_shape(job, s, n, cameras[s], LIGHT, SPP) for s, n in SHAPES.items()}
    rows = []
    for shape, around in SHAPES.items():
        camera, expected = cameras[shape], references[shape]
        pictures = [expected]
        for silhouettes in (True, False):
            bsdf = {"type": "mbtf", "material": str(material), "silhouettes": silhouettes}
            mesh = Chart(shape, around, 1.0).mesh(None, bsdf)
            pictures.append(render_scene(shape_scene(mesh, camera, LIGHT, {"type": "mbtf_path"}), SPP, [1]))
            found, mean = pictures[-1], expected.value.mean()
            rms = np.sqrt(((blocks(found) - blocks(expected)) ** 2).mean()) / blocks(expected).mean()
            print(
                f"{shape}, {'with' if silhouettes else 'without'} silhouettes: mean "
                f"{found.value.mean() / mean:.3f}, RMS of blocks {rms:.1%}, outlines "
                f"{outline_distance(expected, found):.2f} pixels apart",
                flush=True,
            )
        # Without the empty space above and below.
        cut = SIZE // 5 if shape == "torus" else 0
        white = [p.value + p.transmittance[..., None] for p in pictures]
        rows.append(np.concatenate([picture[cut : SIZE - cut] for picture in white], 1))
    Image.fromarray(to_display(np.concatenate(rows), EXPOSURE)).save(
        Path(__file__).with_name("curved.png"), optimize=True
    )


if __name__ == "__main__":
    main()
