"""Jobs of height fields in memory, of which effects are planned."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.planning.job import Job
from mbtf_gen.tile.heightfield_tile import HeightFieldTile
from mbtf_gen.tile.protocol import Tile


def height_field(
    height: NDArray[np.float64], scale: float, color: ArrayLike = 0.5, **maps: Any
) -> HeightFieldTile:
    """A tile of one color, gray or RGB, or of a map of colors; `maps` are its others."""
    base = np.asarray(color, np.float64) * (np.ones(3) if np.ndim(color) == 0 else 1.0)
    return HeightFieldTile(height=height, height_scale=scale).with_maps(base_color=base, **maps)


def job_of(material: Tile, mode: str = "auto", **options: Any) -> Job:
    """The job of a material under a mode of effects; `options` are sections of the configuration."""
    effects = {"mode": mode, **options.pop("effects", {})}
    return Job.of(GeneratorConfig.model_validate({"material": "m", "effects": effects, **options}), material)
