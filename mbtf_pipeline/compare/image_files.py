"""Scenes of a comparison and the files of their images."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.pictures import Camera
from mbtf_pipeline.recipe import FIELD_OF_VIEW, CompareSection, SceneDirection, SceneView

F32 = NDArray[np.float32]
PICTURES = "pictures"


@dataclass(frozen=True)
class Scene:
    """One view under one light at one width of the field of view.

    Attributes
    ----------
    index : of the scene in the comparison, from 0
    name : ``v1-l2-s3``: view, light and width, counted from 1
    tiles_across : width of the field of view at the target, in tile widths
    """

    index: int
    name: str
    view: SceneView
    light: SceneDirection
    tiles_across: float

    def camera(self, size: int) -> Camera:
        """The scene's camera, `size` pixels along each side."""
        view = self.view
        return Camera(
            view.elevation,
            view.azimuth,
            self.tiles_across,
            rows=size,
            columns=size,
            field_of_view=FIELD_OF_VIEW,
        )

    def file(self, what: str) -> str:
        """Path of one of the scene's images without its suffix, relative to the comparison's folder."""
        return f"{PICTURES}/{self.name}-{what}"


def scenes(compare: CompareSection) -> Iterator[Scene]:
    """All scenes of a comparison: views outermost, widths innermost."""
    index = 0
    for v, view in enumerate(compare.views, 1):
        for n, light in enumerate(compare.lights, 1):
            for s, tiles_across in enumerate(compare.tiles_across, 1):
                yield Scene(index, f"v{v}-l{n}-s{s}", view, light, tiles_across)
                index += 1


def with_ending(path: Path, ending: str) -> Path:
    """The path with `ending` appended to its name, which may contain dots."""
    return path.with_name(f"{path.name}{ending}")


def write_channels(path: Path, values: NDArray[Any], names: str) -> None:
    """Write an array (rows, columns, channels) as a float32 EXR image, atomically."""
    import OpenEXR

    from mbtf_core.files.atomic import write_through

    channels = {name: np.ascontiguousarray(values[..., i], np.float32) for i, name in enumerate(names)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    write_through(path, lambda p: OpenEXR.File(header, channels).write(str(p)))


def write_picture(path: Path, value: NDArray[Any], exposure: float) -> None:
    """Write linear RGB (rows, columns, 3) in 1/sr as ``path`` + ``.exr``, and at an exposure in EV as
    ``.png``."""
    from mbtf_core.pictures import write_display

    write_channels(with_ending(path, ".exr"), value, "RGB")
    write_display(path, value, exposure)


# Ending of a fit's HDR-FLIP map.
_FLIP = "-flip.png"


def write_map(path: Path, flip: F32) -> None:
    """Write a map (rows, columns) from 0 to 1 as ``path`` + ``-flip.png``, 8-bit gray, atomically."""
    from mbtf_core.pictures import write_png

    write_png(with_ending(path, _FLIP), np.round(255.0 * np.clip(flip, 0.0, 1.0)).astype(np.uint8))


def read_map(path: Path) -> F32:
    """Read a map (rows, columns) in [0, 1] written by :func:`write_map`.

    Raises
    ------
    InputError : missing or corrupt
    """
    from PIL import Image

    from mbtf_core.errors import InputError

    file = with_ending(path, _FLIP)
    try:
        with Image.open(file) as image:
            return (np.asarray(image.convert("L"), np.float32) / 255.0).astype(np.float32)
    except (OSError, ValueError) as error:
        raise InputError(
            f"cannot be read ({error})", where=file, hint="run the recipe again to recreate it"
        ) from None


def read_halves(path: Path) -> tuple[F32, F32]:
    """Both halves of a reference, linear RGB (rows, columns, 3).

    Raises
    ------
    InputError : missing or corrupt
    """
    from mbtf_core.images.exr import read_channels

    channels = read_channels(with_ending(path, ".exr"), 1 << 26)
    a, b = (np.stack([channels[f"value_{h}.{c}"] for c in "RGB"], axis=-1) for h in "ab")
    return a.astype(np.float32), b.astype(np.float32)


def read_picture(path: Path) -> F32:
    """Linear RGB (rows, columns, 3) of an image; of a reference, the mean of its halves.

    Raises
    ------
    InputError : missing or corrupt
    """
    from mbtf_core.images.exr import read_channels

    channels = read_channels(with_ending(path, ".exr"), 1 << 26)
    if "R" not in channels:
        a, b = read_halves(path)
        return (0.5 * (a + b)).astype(np.float32)
    return np.stack([channels[c] for c in "RGB"], axis=-1).astype(np.float32)
