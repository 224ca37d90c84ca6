"""Makes docs/pictures/curved.png: displaced surfaces, path-traced, beside a fitted material on smooth ones.

From the repository's root: ``.venv/bin/python docs/pictures/make_curved_picture.py``. It generates data of
``twisted_wool`` and fits them into ``out/curved/`` first, in some minutes. Columns: Mitsuba's path tracer on
the displaced surface (``mbtf-gen reference --surface``), the material with silhouettes, and without. Printed,
of the material against the path-traced picture: mean, RMS difference of blocks of 16 x 16 pixels over the
mean, both of blocks that show the object, its noise included, contrast of pixels that both show, and mean
distance in pixels of the outlines, and of those seen from behind along the light, as the shadow has them.

With ``--table``, four materials on six surfaces are measured instead, in an hour, and no picture is made.

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
from mbtf_gen.config.pictures import Shape
from mbtf_gen.engine.runtime import load_mitsuba
from mbtf_gen.pictures.displaced_mesh import DisplacedMesh
from mbtf_gen.pictures.shapes import Chart, render_scene, render_shape, shape_scene

ROOT = Path(__file__).parents[2]
OUT = ROOT / "out" / "curved"
SIZE, SPP, EXPOSURE = 288, 32, 2.3
MESH = 128
CHARTS: dict[str, Shape] = {"sphere": "sphere", "cylinder": "cylinder", "torus": "torus"}
# Elevation and azimuth of view and light, by surface.
DIRECTIONS = {
    "sphere": ((20.0, -90.0), (40.0, -40.0)),
    "cylinder": ((25.0, -90.0), (40.0, -40.0)),
    "torus": ((40.0, -90.0), (40.0, -40.0)),
    "spot": ((12.0, 130.0), (40.0, 180.0)),
    "cloth": ((10.0, -105.0), (40.0, -25.0)),
}
# Tiles around charts, or per unit of the mesh files: radii of 2 tiles, and of 4.5.
TILES = {"sphere": 13, "spot": 16.0, "cloth": 5.0}
MEASURED = {"sphere": 13, "sphere, radius 4.5": 28, "cylinder": 13, "torus": 13, "spot": 16.0, "cloth": 5.0}
MATERIALS = ("twisted_wool", "cliff_rock", "insulation_foam", "turtle_shell")


def fitted(name: str) -> Path:
    """The fitted material of an asset, made where it is missing."""
    out = OUT / name
    for folder, words in {
        "shards": f"mbtf_gen assets/{name} --resolution 64 --mesh {MESH} --queries 800/texel --spp 16",
        "material": f"mbtf_fit {out}/shards --steps 6000 --set network.width=32"
        " --set network.relief.places=2",
    }.items():
        print("python -m", words, f"-o {out / folder}", flush=True)
        command = [sys.executable, "-m", *words.split(), "-o", str(out / folder), "--quiet"]
        subprocess.run(command, check=True, cwd=ROOT)
    return out / "material"


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


def seen(name: str, tiles: float) -> tuple[Chart | DisplacedMesh, Camera, Camera, NDArray[np.float64]]:
    """A surface, the camera, one that looks from the light and sees the shadow, and the light."""
    shape, (view, light) = name.split(",")[0], DIRECTIONS[name.split(",")[0]]
    surface: Chart | DisplacedMesh
    if shape in CHARTS:
        surface = Chart(CHARTS[shape], int(tiles), 1.0)
    else:
        path = hanging_cloth() if shape == "cloth" else Path(__file__).with_name("spot.ply")
        surface = DisplacedMesh.read(path, tiles, 1.0, "y" if shape == "spot" else "z")
    across = 2.16 * surface.radius
    camera, behind = (
        Camera(*at, across, rows=SIZE, columns=SIZE) for at in (view, (-light[0], light[1] + 180.0))
    )
    return surface, camera, behind, from_angles(*light)


def compared(found: Any, expected: Any, shadows: tuple[Any, Any]) -> str:
    """What is printed of a picture and its reference."""
    a, b = blocks(found), blocks(expected)
    shown = b > 0
    rms = np.sqrt(((a - b)[shown] ** 2).mean()) / b[shown].mean()
    inside = (expected.transmittance < 0.5) & (found.transmittance < 0.5)
    gray = [image.value.mean(-1)[inside] for image in (found, expected)]
    contrast = [values.std() / values.mean() for values in gray]
    return (
        f"mean {found.value.mean() / expected.value.mean():.3f}, RMS of blocks {rms:.1%}, contrast "
        f"{contrast[0] / contrast[1]:.2f}, outlines {outline_distance(expected, found):.2f} and of shadows "
        f"{outline_distance(*shadows):.2f} pixels apart"
    )


def main() -> None:
    """Write the picture, or print the table."""
    if sys.argv[1:] not in ([], ["--table"]):
        raise SystemExit(__doc__)
    table = len(sys.argv) > 1
    materials = {name: fitted(name) for name in (MATERIALS if table else MATERIALS[:1])}
    load_mitsuba()
    import mbtf_fit.backends.mitsuba
    from mbtf_gen.planning.job import Job

    mbtf_fit.backends.mitsuba.register()
    views = {name: seen(name, tiles) for name, tiles in (MEASURED if table else TILES).items()}
    jobs = {
        name: Job.load(GeneratorConfig(material=str(ROOT / "assets" / name), geometry={"mesh": MESH}))
        for name in materials
    }
    # First, as Mitsuba's path tracer would compile materials that are loaded.
    references = {
        (name, shape): (
            render_shape(job, surface.mesh, camera, light, SPP),
            render_shape(job, surface.mesh, behind, light, SPP, max_depth=2),
        )
        for name, job in jobs.items()
        for shape, (surface, camera, behind, light) in views.items()
    }
    rows = []
    for (name, shape), (expected, shadow) in references.items():
        surface, camera, behind, light = views[shape]
        pictures = [expected]
        for silhouettes in (True,) if table else (True, False):
            bsdf = {"type": "mbtf", "material": str(materials[name]), "silhouettes": silhouettes}
            mesh = surface.mesh(None, bsdf)

            def render(at: Camera, mesh: Any = mesh, light: Any = light, **options: int) -> Any:
                return render_scene(shape_scene(mesh, at, light, {"type": "mbtf_path", **options}), SPP, [1])

            found, beneath = render(camera), render(behind, max_depth=6)
            pictures.append(found)
            line = compared(found, expected, (shadow, beneath))
            print(f"{name}, {shape}, {'with' if silhouettes else 'without'} silhouettes: {line}", flush=True)
        # Without the empty space above and below.
        full = np.flatnonzero((np.asarray(expected.transmittance) < 0.5).any(1))
        cut = slice(max(0, full[0] - 6), full[-1] + 7)
        white = [p.value + np.asarray(p.transmittance)[..., None] for p in pictures]
        rows.append(np.concatenate([picture[cut] for picture in white], 1))
    if not table:
        picture = to_display(np.concatenate(rows), EXPOSURE)
        Image.fromarray(picture).save(Path(__file__).with_name("curved.png"), optimize=True)


if __name__ == "__main__":
    main()
