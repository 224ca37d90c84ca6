"""Scenes of a comparison and the files of their images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_core.pictures import Camera
from mbtf_gen.config.pictures import Direction
from mbtf_pipeline.recipe import FIELD_OF_VIEW, PIXEL_TEXELS, CompareSection, SceneView

F32 = NDArray[np.float32]
PICTURES = "pictures"
# Ending of a fit's HDR-FLIP map.
_FLIP = "-flip.png"


@dataclass(frozen=True)
class Scene:
    """One view under one light at one width of the field of view at the target, in tile widths. Its name
    ``v1-l2-s3`` counts views, lights and widths from 1, its index in the comparison from 0."""

    index: int
    name: str
    view: SceneView
    light: Direction
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
    """All scenes of a comparison: views outermost, widths innermost. Only their number is right where the
    widths are those of the data."""
    widths = compare.tiles_across or PIXEL_TEXELS
    numbered = product(enumerate(compare.views, 1), enumerate(compare.lights, 1), enumerate(widths, 1))
    for index, ((v, view), (n, light), (s, tiles_across)) in enumerate(numbered):
        yield Scene(index, f"v{v}-l{n}-s{s}", view, light, tiles_across)


def with_ending(path: Path, ending: str) -> Path:
    """The path with `ending` appended to its name, which may contain dots."""
    return path.with_name(f"{path.name}{ending}")


def write_channels(path: Path, values: NDArray[Any], names: str) -> None:
    """Write an array (rows, columns, channels) as a float32 EXR image, atomically."""
    import OpenEXR

    from mbtf_core.images import exr

    channels = {name: np.ascontiguousarray(values[..., i], np.float32) for i, name in enumerate(names)}
    exr.write_channels(path, channels, {"compression": OpenEXR.ZIP_COMPRESSION})


def read_channels(path: Path, *sets: Sequence[str]) -> F32:
    """Channels (rows, columns, channels) of an EXR image: the first of some sets that it has; an InputError
    where it is missing or corrupt."""
    from mbtf_core.images import exr

    found = exr.read_layers(path, 1 << 26)[0]
    names = next((names for names in sets if found.keys() >= set(names)), None)
    if names is None:
        raise InputError(f"has no channels {', '.join(sets[0])}", where=path)
    return np.stack([found[name] for name in names], axis=-1).astype(np.float32)


# Channels of both halves of a reference.
_HALVES = [f"value_{half}.{color}" for half in "ab" for color in "RGB"]


def read_picture(path: Path) -> F32:
    """Linear RGB (rows, columns, 3) of a comparison's picture, ``path`` + ``.exr``: of a reference the mean
    of its halves; errors are those of :func:`read_channels`."""
    found = read_channels(with_ending(path, ".exr"), "RGB", _HALVES)
    return found if found.shape[-1] == 3 else 0.5 * (found[..., :3] + found[..., 3:])


def read_halves(path: Path) -> tuple[F32, F32]:
    """Both halves of a reference, linear RGB (rows, columns, 3); errors likewise."""
    both = read_channels(with_ending(path, ".exr"), _HALVES)
    return both[..., :3], both[..., 3:]


def write_map(path: Path, flip: F32) -> None:
    """Write a map (rows, columns) from 0 to 1 as ``path`` + ``-flip.png``, 8-bit gray, atomically."""
    from mbtf_core.pictures import write_png

    write_png(with_ending(path, _FLIP), np.round(255.0 * np.clip(flip, 0.0, 1.0)).astype(np.uint8))


def read_map(path: Path) -> F32:
    """Read a map (rows, columns) in [0, 1] that :func:`write_map` wrote; an InputError where it is missing or
    corrupt."""
    from mbtf_core.images.read import read_image

    return read_image(with_ending(path, _FLIP)).pixels[..., 0].astype(np.float32)
