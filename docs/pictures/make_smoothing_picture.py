"""Make smoothing.png: a tile at its finest level by several fits, one row each.

    python docs/pictures/make_smoothing_picture.py MATERIAL ...

Left from above, right from 35 degrees under a low light; each pixel is one query.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mbtf_core.exposure import to_display
from mbtf_fit import Material

SIZE, EXTENT, EXPOSURE = 256, 0.6, 1.58
# (elevation, azimuth) of view and light in degrees.
VIEWS = (((90, 0), (50, 45)), ((35, -90), (25, 160)))


def direction(elevation: float, azimuth: float) -> NDArray[np.float32]:
    """Unit vector (3,)."""
    e, a = np.radians(elevation), np.radians(azimuth)
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], np.float32)


def picture(material: Material) -> NDArray[np.uint8]:
    """(SIZE, 2 SIZE, 3), sRGB."""
    at = (np.arange(SIZE) + 0.5) / SIZE * EXTENT
    u = np.stack(np.meshgrid(at, 1 - at), -1).reshape(-1, 2).astype(np.float32)
    sigma = np.full(len(u), min(material.lattice.sigma_range), np.float32)
    parts = []
    for view, light in VIEWS:
        omega_i, omega_o = (np.tile(direction(*d), (len(u), 1)) for d in (light, view))
        value = material.evaluate(u, sigma, omega_i, omega_o).reshape(SIZE, SIZE, 3)
        parts.append(to_display(value, EXPOSURE))
    return np.concatenate(parts, 1)


def main() -> None:
    rows = [picture(Material.load(folder)) for folder in sys.argv[1:]]
    Image.fromarray(np.concatenate(rows)).save(Path(__file__).with_name("smoothing.png"), optimize=True)


if __name__ == "__main__":
    main()
