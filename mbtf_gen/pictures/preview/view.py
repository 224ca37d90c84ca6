"""The camera of a preview, for the mesh and the path-traced picture alike: it holds a block of tiles."""

from __future__ import annotations

from itertools import product

import numpy as np

from mbtf_gen.pictures.camera import Camera

# Share of the picture, along its tighter side, that the block fills.
_FILL = 0.94
_PROPORTION = 0.75


def block_camera(
    elevation: float, azimuth: float, *, tiles: int, aspect: float, relief: float, columns: int
) -> Camera:
    """Camera that looks at the middle of `tiles` × `tiles` tiles and just holds them; pictures are 4:3.

    Parameters
    ----------
    elevation, azimuth : where it stands, in degrees
    aspect, relief : H/W and largest depth of the tile, in tile widths
    columns : pixels across
    """
    rows = max(1, round(_PROPORTION * columns))
    target = (0.5 * tiles, 0.5 * tiles * aspect)
    x, y, z = zip(*product((0.0, tiles), (0.0, tiles * aspect), (0.0, -relief)), strict=True)
    corners = np.column_stack([x, y, z])

    def camera(tiles_across: float) -> Camera:
        return Camera(elevation, azimuth, tiles_across, target, rows, columns)

    def holds(tiles_across: float) -> bool:
        trial = camera(tiles_across)
        forward, right, up = trial.frame()
        offset = corners - trial.position
        depth = offset @ forward
        half = 0.5 * _FILL * trial.pixel_pitch
        return bool(
            (depth > 0).all()
            and (np.abs(offset @ right) <= half * columns * depth).all()
            and (np.abs(offset @ up) <= half * rows * depth).all()
        )

    high = float(tiles * max(1.0, aspect))
    while not holds(high):
        high *= 2.0
    low = 0.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if holds(middle) else (middle, high)
    return camera(high)
