"""Makes docs/pictures/zoom_series.png and grazing.png: a fitted material in Mitsuba beside truly filtered
pictures, from above and at 16° above the plane.

From the repository's root, after ``make demo``: ``.venv/bin/python docs/pictures/make_zoom_series.py``.
Rows: path-traced pixels of the micro-geometry (``mbtf-gen reference --kind pixel``, its command is printed);
the material with footprints (``mbtf_path``); from above the material at its finest level everywhere, as stock
integrators read it, and at 16° the material with round footprints. Rays pass through the pixels' centers:
one shows aliasing as it is, the mean of 64 the elongated footprint. Printed, of gray values and as shares of
the reference's mean: the picture's mean, its contrast (standard deviation) beside the reference's, and the
RMS difference of the two; the reference's noise is taken out. More contrast than the reference's is aliasing,
less is blur.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from mbtf_core.color import ALBEDO_EXPOSURE, to_display
from mbtf_core.data.shard_files import read_exr
from mbtf_core.directions import from_angles
from mbtf_core.pictures import Camera
from mbtf_gen.engine.runtime import load_mitsuba

ROOT = Path(__file__).parents[2]
MATERIAL = ROOT / "out" / "quickstart" / "fits" / "relief"
LIGHT, SIZE, SPP = (45.0, 45.0), 160, 128
# As the recipe generates its data.
OPTIONS = ("--mesh", "256")
ELONGATED = {"type": "mbtf_path", "max_depth": 2}


@dataclass(frozen=True)
class Series:
    """Pictures of a view (elevation, azimuth) by distance; integrators and rays per pixel by caption."""

    view: tuple[float, float]
    tiles_across: tuple[float, ...]
    ways: Mapping[str, tuple[Mapping[str, Any], int]]


SERIES = {
    "zoom_series": Series(
        (60.0, -90.0),
        (0.5, 2.0, 8.0, 32.0, 128.0),
        {
            "material, mbtf_path": (ELONGATED, 64),
            "material, finest level": ({"type": "path", "max_depth": 2}, 1),
        },
    ),
    "grazing": Series(
        (16.0, -60.0),
        (1.0, 2.0, 4.0, 8.0, 16.0),
        {
            "material, mbtf_path": (ELONGATED, 64),
            "material, round footprints": ({**ELONGATED, "max_anisotropy": 1}, 1),
        },
    ),
}
GAP, CAPTION = 6, 24


def reference(
    view: tuple[float, float], tiles_across: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Truly filtered pixels, two independent halves (SIZE, SIZE, 3)."""
    words = ["reference", "assets/turtle_shell", "--view", "{:g},{:g}".format(*view)]
    words += [
        "--light",
        "{:g},{:g}".format(*LIGHT),
        "--tiles-across",
        f"{tiles_across:g}",
        "--size",
        str(SIZE),
    ]
    words += ["--spp", str(SPP), "--kind", "pixel", *OPTIONS]
    print("mbtf-gen", *words, flush=True)
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "pictures"
        command = [sys.executable, "-m", "mbtf_gen", *words, "-o", str(output), "--quiet"]
        subprocess.run(command, check=True, cwd=ROOT, stdout=subprocess.DEVNULL)
        (picture,) = output.glob("*.exr")
        arrays = read_exr(picture)
    a, b = (arrays[f"value_{half}"].reshape(SIZE, SIZE, 3).astype(np.float64) for half in "ab")
    return a, b


def rendered(
    mi: Any, view: tuple[float, float], tiles_across: float, integrator: Mapping[str, Any], rays: int
) -> NDArray[np.float64]:
    """The material on a plane under a delta light of unit irradiance, rays through each pixel's center."""
    import drjit as dr

    camera = Camera(*view, tiles_across=tiles_across, rows=SIZE, columns=SIZE)
    omega_i = from_angles(*LIGHT)
    half = 100.0 * tiles_across
    to_world = mi.ScalarTransform4f().scale([half, half, 1.0])
    # The rectangle's texture coordinates run from 0 to 1; row 0 of images lies at v = 0.
    bsdf = {"type": "mbtf", "material": str(MATERIAL), "uv_scale": 2.0 * half}
    scene = mi.load_dict(
        {
            "type": "scene",
            "plane": {
                "type": "rectangle",
                "to_world": to_world @ mi.ScalarTransform4f().scale([1.0, -1.0, 1.0]),
                "bsdf": bsdf,
            },
            "light": {
                "type": "directional",
                "direction": [-float(c) for c in omega_i],
                "irradiance": float(1.0 / omega_i[2]),
            },
            "sensor": {
                "type": "perspective",
                "fov": camera.field_of_view,
                "to_world": mi.ScalarTransform4f().look_at(
                    list(map(float, camera.position)), [*camera.target, 0.0], [0.0, 0.0, 1.0]
                ),
                "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE},
            },
        }
    )
    index = dr.arange(mi.UInt32, SIZE * SIZE * rays) // rays
    center = mi.Point2f(mi.Float(index % SIZE) + 0.5, mi.Float(index // SIZE) + 0.5) / SIZE
    ray, _ = scene.sensors()[0].sample_ray_differential(0.0, 0.5, center, mi.Point2f(0.5))
    sampler = mi.load_dict({"type": "independent", "sample_count": 1})
    sampler.seed(0, SIZE * SIZE * rays)
    value, _, _ = mi.load_dict(dict(integrator)).sample(scene, sampler, ray)
    out: NDArray[np.float64] = np.array(value, np.float64).T.reshape(SIZE, SIZE, rays, 3).mean(2)
    return out


def draw_series(mi: Any, name: str, series: Series) -> None:
    """Write the sheet of a series."""
    rows = ("reference", *series.ways)
    sheet = Image.new(
        "RGB", (len(series.tiles_across) * (SIZE + GAP) - GAP, 3 * (SIZE + CAPTION)), (255, 255, 255)
    )
    draw = ImageDraw.Draw(sheet)
    for column, tiles_across in enumerate(series.tiles_across):
        halves = reference(series.view, tiles_across)
        truth = 0.5 * (halves[0] + halves[1])
        a, b = (half.mean(-1) for half in halves)
        level = 0.5 * (a.mean() + b.mean())
        contrast = ((a - a.mean()) * (b - b.mean())).mean()
        pictures = [truth, *(rendered(mi, series.view, tiles_across, *way) for way in series.ways.values())]
        for row, (way, picture) in enumerate(zip(rows, pictures, strict=True)):
            place = (column * (SIZE + GAP), row * (SIZE + CAPTION))
            words = [way] if column == 0 else []
            words += [f"{tiles_across:g} tile{'s' * (tiles_across != 1)} across"] if row == 0 else []
            caption = ", ".join(words)
            draw.text((place[0] + 2, place[1] + 3), caption, (30, 30, 30), ImageFont.load_default(12))
            display = to_display(picture.astype(np.float32), ALBEDO_EXPOSURE)
            sheet.paste(Image.fromarray(display), (place[0], place[1] + CAPTION))
            gray = picture.mean(-1)
            error, true = (
                max(float(x), 0.0) ** 0.5 / level for x in (((gray - a) * (gray - b)).mean(), contrast)
            )
            print(
                f"{tiles_across:6g} tiles across, {way:26} mean {gray.mean() / level:.3f}, contrast "
                f"{gray.std() / level:.3f} for {true:.3f}, RMS {error:.3f}",
                flush=True,
            )
    sheet.save(Path(__file__).with_name(f"{name}.png"), optimize=True)


def main() -> None:
    """Write all sheets."""
    mi = load_mitsuba()
    import mbtf_fit.backends.mitsuba

    mbtf_fit.backends.mitsuba.register()
    for name, series in SERIES.items():
        draw_series(mi, name, series)


if __name__ == "__main__":
    main()
