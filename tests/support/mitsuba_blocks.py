"""Blocks of tiles as scenes of unmodified Mitsuba, and their renders of queries."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.schema import Queries
from mbtf_gen.tile.heights import HeightGrid
from support.mitsuba_shapes import height_field
from support.scenes import mi, queries, rocks

# After support.scenes, which loads Mitsuba.
from mbtf_gen.render.scene import CLEARANCE, LONG_SIDE  # isort: skip

SPP = 32


def block(grid: HeightGrid, bsdf: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Scene entries of 5 × 5 instances of the tile, in the generator's scene units."""
    unit = LONG_SIDE / max(1.0, grid.aspect)
    group = {"type": "shapegroup", "tile": height_field(grid, unit, folder, bsdf)}
    return {"group": group, **instances(unit, grid.aspect * unit)}


def instances(width: float, height: float, columns: int = 2, rows: int = 2) -> dict[str, Any]:
    """Entries of a block of instances of the scene's ``group``, so many on each side of the central one."""
    shift = mi.ScalarTransform4f().translate
    same = {"type": "instance", "group": {"type": "ref", "id": "group"}}
    return {
        f"tile_{i + columns}_{j + rows}": {**same, "to_world": shift([i * width, j * height, 0.0])}
        for i in range(-columns, columns + 1)
        for j in range(-rows, rows + 1)
    }


def mitsuba_halves(
    entries: dict[str, Any],
    emitter: dict[str, Any],
    q: Queries,
    aspect: float,
    max_depth: int,
    integrator: str = "path",
    more: dict[str, Any] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Two independent renders of the queries by ``mi.render``: (n, 3) each, SPP/2 rays per query."""
    n = len(q.sigma)
    columns = 64
    assert n % columns == 0
    scene = mi.load_dict(
        {
            "type": "scene",
            "embree_use_robust_intersections": True,
            "integrator": {
                "type": integrator,
                "max_depth": max_depth,
                "rr_depth": 1000,
                "hide_emitters": True,
            },
            "sensor": {
                "type": "mbtf_queries",
                "unit": LONG_SIDE / max(1.0, aspect),
                "aspect": aspect,
                "start": CLEARANCE,
                "sampler": {"type": "independent", "sample_count": SPP // 2},
                "film": {
                    "type": "hdrfilm",
                    "width": columns,
                    "height": n // columns,
                    "rfilter": {"type": "box"},
                    "pixel_format": "rgb",
                    "component_format": "float32",
                },
            },
            "light": emitter,
            **({} if more is None else {"more": more}),
            **entries,
        }
    )
    scene.sensors()[0].set_queries(q)
    for e in scene.emitters():
        if hasattr(e, "set_directions"):
            e.set_directions(q.omega_i)
    a, b = (np.array(mi.render(scene, seed=s), np.float64).reshape(n, 3) for s in (21, 22))
    return a, b


def random_queries(
    n: int, sigma: float, omega_i: NDArray[np.float64] | None = None, elevation: float = 35.0
) -> Queries:
    """Queries over the tile; views, and lights where none is given, above the elevation."""
    rng = np.random.default_rng(6)

    def above() -> NDArray[np.float64]:
        r = np.sqrt(rng.random(n)) * np.cos(np.radians(elevation))
        phi = 2 * np.pi * rng.random(n)
        return np.stack([r * np.cos(phi), r * np.sin(phi), np.sqrt(1 - r * r)], axis=-1)

    return queries(rng.random((n, 2)), sigma, above() if omega_i is None else omega_i, above(), n)


GRIDS = {"square": rocks(48, 0.2), "wide": HeightGrid(rocks(48, 0.2).z[:24], 0.5)}
