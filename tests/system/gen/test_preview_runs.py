"""``mbtf-gen preview``: the right way round."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from support.commands import run_all

# Quadrants of the map: top left, top right, bottom left, bottom right.
QUADRANTS = {"red": (1, 0, 0), "green": (0, 1, 0), "blue": (0, 0, 1), "white": (1, 1, 1)}
COMMAND = "preview maps -o tilted --tiles 1 --size 96 --spp 4"


def write_inputs(folder: Path) -> None:
    """A material whose quadrants have different colors and heights; 2:1, so that nothing may be swapped."""
    (folder / "maps").mkdir()
    color = np.zeros((16, 32, 3), np.uint8)
    height = np.zeros((16, 32), np.float32)
    for (j, i), rgb, z in zip(np.ndindex(2, 2), QUADRANTS.values(), (0.04, 0.0, 0.02, 0.01), strict=True):
        part = (slice(8 * j, 8 * j + 8), slice(16 * i, 16 * i + 16))
        color[part] = 40 + 180 * np.array(rgb)
        height[part] = z
    Image.fromarray(color).save(folder / "maps/base_color.png")
    np.save(folder / "maps/height.npy", height)


def quadrant(picture: NDArray[np.float64]) -> NDArray[np.intp]:
    """Which of the four colors each pixel has; -1 where that is not clear."""
    colors = np.array(list(QUADRANTS.values()), np.float64)
    hue = picture / np.maximum(picture.max(axis=-1, keepdims=True), 0.05)
    distance = np.linalg.norm(hue[..., None, :] - colors, axis=-1)
    return np.where(distance.min(axis=-1) < 0.6, distance.argmin(axis=-1), -1)


def test_colors_lie_in_the_quadrants_of_the_map(tmp_path: Path) -> None:
    """The camera stands towards -v: the map's first row is far, its first column left."""
    write_inputs(tmp_path)
    (done,) = run_all([COMMAND.split()], tmp_path)
    assert done.code == 0, done.err
    picture = quadrant(np.asarray(Image.open(tmp_path / "tilted/beauty.png").convert("RGB")) / 255)
    # Positions close to the picture's middle, where the tile's middle is.
    for number, (down, right) in enumerate([(-5, -12), (-5, 12), (6, -12), (6, 12)]):
        part = picture[36 + down - 2 : 36 + down + 3, 48 + right - 4 : 48 + right + 5]
        assert (part == number).mean() > 0.8, number
