"""The camera of a preview, for the mesh and the path-traced picture alike: it fits a grid of tiles."""

from __future__ import annotations

from itertools import product

import numpy as np

from mbtf_gen.pictures.camera import Camera

# Fraction of the picture, along its tighter side, that the tiles fill.
_FILL = 0.94
_PROPORTION = 0.75


def tiles_camera(
    elevation: float, azimuth: float, *, tiles: int, aspect: float, displacement_range: float, columns: int
) -> Camera:
    """Camera that looks at the center of `tiles` × `tiles` tiles and just fits them; pictures are 4:3.

    Parameters
    ----------
    elevation, azimuth : direction towards the camera, in degrees
    aspect : H/W of the tile
    displacement_range : largest depth of the tile, in tile widths
    columns : pixels across
    """
    rows = max(1, round(_PROPORTION * columns))
    target = (0.5 * tiles, 0.5 * tiles * aspect)
    x, y, z = zip(*product((0.0, tiles), (0.0, tiles * aspect), (0.0, -displacement_range)), strict=True)
    corners = np.column_stack([x, y, z])

    def camera(tiles_across: float) -> Camera:
        return Camera(elevation, azimuth, tiles_across, target, rows, columns)

    def fits(tiles_across: float) -> bool:
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
    while not fits(high):
        high *= 2.0
    low = 0.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if fits(middle) else (middle, high)
    return camera(high)
