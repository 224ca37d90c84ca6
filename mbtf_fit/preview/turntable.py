"""The turntable: a ball and a plate of the material, with a key light, a rim light and a dim sky.

Together the lights have unit irradiance on the plate, as the light of the sheet, so that both pictures have
the same exposure.

The ball's texture coordinates are a Mercator projection, which is conformal: tiles are square everywhere and
shrink towards the poles, where footprints exceed them. Tiles on the plate are as large as on the equator.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mbtf_core.directions import from_angles
from mbtf_core.files.atomic import write_file
from mbtf_core.run.signals import reinstall_handlers
from mbtf_fit.backends.mitsuba.stored_material import F32
from mbtf_fit.preview.config import TurntableSection
from mbtf_gen.engine.types import BSDF, Scene
from mbtf_gen.pictures.shapes import mitsuba_mesh

# Latitude beyond which the projection continues with constant scale.
STEEPEST = np.radians(84.0)
# Cells around and from pole to pole; the plate's radius in those of the ball.
CELLS = (192, 96)
PLATE = 1.9
# Elevation and azimuth of camera, key and rim light, in degrees.
CAMERA, KEY, RIM = (24.0, -90.0), (42.0, -150.0), (25.0, 60.0)
# Irradiance of the lights across their rays and radiance of the sky, before their scaling to unit irradiance.
_KEY, _RIM, _SKY = 2.6, 0.7, 0.22
_TOTAL = float(_KEY * np.sin(np.radians(KEY[0])) + _RIM * np.sin(np.radians(RIM[0])) + np.pi * _SKY)
KEY_IRRADIANCE, RIM_IRRADIANCE, SKY = _KEY / _TOTAL, _RIM / _TOTAL, _SKY / _TOTAL
FIELD_OF_VIEW = 26.0
# Standard deviation of the pixel filter; Mitsuba's 0.5 shows the noise of a few paths per pixel.
FILTER = 0.8
# Milliseconds of one rotation.
TURN = 2400


def ball(bsdf: BSDF, tiles: int) -> Any:
    """The unit sphere with a number of tiles around its equator; texture coordinates are in tile widths."""
    columns, rows = CELLS
    azimuth, latitude = np.meshgrid(
        np.linspace(0.0, 2.0 * np.pi, columns + 1), np.linspace(np.pi / 2, -np.pi / 2, rows + 1)
    )
    steep = np.clip(latitude, -STEEPEST, STEEPEST)
    north = np.arctanh(np.sin(steep)) + (latitude - steep) / np.cos(STEEPEST)
    cosine = np.cos(latitude)
    position = np.stack([cosine * np.cos(azimuth), cosine * np.sin(azimuth), np.sin(latitude)], -1)
    # Mitsuba's v grows downwards, as the rows of images do.
    uv = np.stack([azimuth, -north], -1) * (tiles / (2.0 * np.pi))
    corner = np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)
    right, below = corner + 1, corner + columns + 1
    faces = np.stack([corner, below, below + 1, corner, below + 1, right], -1).reshape(-1, 3)
    return mitsuba_mesh(
        "ball", bsdf, position.reshape(-1, 3), uv.reshape(-1, 2), faces, position.reshape(-1, 3)
    )


def plate(bsdf: BSDF, tiles: int) -> Any:
    """A disc under the ball."""
    angle = np.linspace(0.0, 2.0 * np.pi, CELLS[0], endpoint=False)
    flat = PLATE * np.concatenate([np.zeros((1, 2)), np.stack([np.cos(angle), np.sin(angle)], -1)])
    position = np.concatenate([flat, np.full((len(flat), 1), -1.0)], 1)
    uv = flat * (1.0, -1.0) * (tiles / (2.0 * np.pi))
    rim = np.arange(CELLS[0])
    faces = np.stack([np.zeros_like(rim), 1 + rim, 1 + (rim + 1) % CELLS[0]], -1)
    return mitsuba_mesh("plate", bsdf, position, uv, faces)


def _transforms(turned: float) -> dict[str, Any]:
    """Camera and lights to world, after a rotation of the plate in degrees; lights emit along +z of their own
    frames."""
    camera, key, rim = (from_angles(elevation, azimuth - turned) for elevation, azimuth in (CAMERA, KEY, RIM))
    target = np.array([0.0, 0.0, -0.25])
    origin = target + 2.1 / np.tan(np.radians(FIELD_OF_VIEW / 2.0)) * camera
    ends = {"sensor": (origin, target), "key": (np.zeros(3), -key), "rim": (np.zeros(3), -rim)}
    return {
        name: mi.ScalarTransform4f().look_at(a.tolist(), b.tolist(), [0.0, 0.0, 1.0])
        for name, (a, b) in ends.items()
    }


def scene_of(bsdf: BSDF, section: TurntableSection) -> Scene:
    """The scene before its rotation."""
    at, tiles = _transforms(0.0), section.tiles_around(bsdf.evaluator.lattice.shape()[1])
    return mi.load_dict(
        {
            "type": "scene",
            "ball": ball(bsdf, tiles),
            "plate": plate(bsdf, tiles),
            "key": {"type": "directional", "to_world": at["key"], "irradiance": KEY_IRRADIANCE},
            "rim": {"type": "directional", "to_world": at["rim"], "irradiance": RIM_IRRADIANCE},
            "sky": {"type": "constant", "radiance": SKY},
            "sensor": {
                "type": "perspective",
                "fov": FIELD_OF_VIEW,
                "to_world": at["sensor"],
                "film": {
                    "type": "hdrfilm",
                    "width": section.size,
                    "height": section.size,
                    "filter": {"type": "gaussian", "stddev": FILTER},
                },
                "sampler": {"type": "independent"},
            },
        }
    )


def frames(bsdf: BSDF, section: TurntableSection) -> Iterator[F32]:
    """Linear pictures (size, size, 3) of one rotation. Camera and lights rotate, which is equivalent."""
    scene = scene_of(bsdf, section)
    integrator = mi.load_dict({"type": "mbtf_path", "max_depth": 4})
    parameters = mi.traverse(scene)
    for frame in range(section.frames):
        for name, to_world in _transforms(360.0 * frame / section.frames).items():
            parameters[f"{name}.to_world"] = mi.Transform4f(to_world)
        parameters.update()
        picture = mi.render(scene, integrator=integrator, spp=section.spp, seed=frame)
        reinstall_handlers()
        if integrator.should_stop():
            signal.raise_signal(signal.SIGINT)
        dr.eval(picture)
        yield np.array(picture, np.float32)


def write_gif(path: Path, pictures: Sequence[NDArray[np.uint8]]) -> None:
    """Write an endlessly repeated animation with a common palette, atomically."""
    strip = Image.fromarray(np.concatenate(pictures[:: max(1, len(pictures) // 8)], axis=0))
    palette = strip.quantize(255, method=Image.Quantize.MEDIANCUT)
    coded = [
        Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures
    ]
    pause = max(20, round(TURN / len(coded)))

    options = {"append_images": coded[1:], "duration": pause, "loop": 0, "optimize": False}
    write_file(path, lambda file: coded[0].save(file, format="GIF", save_all=True, **options))
