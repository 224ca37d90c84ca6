"""What a card, ``croissant.json`` and the picture state of a data set, from its manifest and its numbers.

Statistics are those of evenly spaced rows of all shards, about a million queries at most. Independent units
are queries of the shuffled layout, images of the image layout, positions of the slices layout.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.shard_files import Arrays
from mbtf_core.files.atomic import Stored
from mbtf_core.stats import Estimate, mean_estimate, pooled_relative_error
from mbtf_gen.config.exchange import PublishConfig

TAGS = (
    *("btf", "mbtf", "brdf", "reflectance", "appearance", "material", "rendering", "computer-graphics"),
    *("neural-materials", "level-of-detail"),
)
_LAYOUTS = {
    "shuffled": "one query; rows are in random order",
    "image": "one image of queries that share light, view and footprint",
    "slices": "one position under all pairs of lights and views, or one query of the test split",
}
# Names of files that do not name a material.
_GENERIC = ("material", "maps", "heights", "height", "")


@dataclass(frozen=True)
class Facts:
    """A data set that is published.

    Attributes
    ----------
    data : the data set
    config : what its publishers say
    name : name of the published data set
    samples : evenly spaced rows of each split
    files : the published files by name
    maps : whether the input files of the material are among them
    """

    data: Dataset
    config: PublishConfig
    name: str
    samples: Mapping[str, Arrays]
    files: Mapping[str, Stored]
    maps: bool = False

    @property
    def measured(self) -> Mapping[str, Any] | None:
        """What the manifest says of measured data; None of generated ones."""
        return self.data.manifest.get("measured")

    @property
    def summary(self) -> str:
        """One sentence about the data set, of plain text."""
        counts = " and ".join(
            f"{self.queries(name):,} {'training' if name == 'train' else name}" for name in self.samples
        )
        return (
            f"Multi-resolution bidirectional texture function (MBTF) of one material tile: {counts} queries "
            f"of {'measured' if self.measured else 'path-traced'} reflectance with position, footprint, "
            "direction of light and direction of view."
        )

    @property
    def row(self) -> str:
        """What one row is."""
        return _LAYOUTS[self.data.layout]

    @property
    def shapes(self) -> dict[str, dict[str, tuple[int, ...]]]:
        """Shape of one row of each array of each split."""
        return {
            split: {name: array.shape[1:] for name, array in arrays.items()}
            for split, arrays in self.samples.items()
        }

    @property
    def same_shapes(self) -> bool:
        """Whether rows of all splits have the same shapes."""
        first, *others = self.shapes.values()
        return all(shapes == first for shapes in others)

    def queries(self, split: str) -> int:
        """Number of queries of a split."""
        return int(self.data.manifest["splits"][split]["queries"])

    def mean(self, split: str) -> list[Estimate]:
        """Mean value of each color channel of a split, in 1/sr."""
        value = mean_of(self.samples[split])
        weight = _weight(self.samples[split])
        return [mean_estimate(value[..., channel], weight) for channel in range(3)]

    def noise(self, split: str) -> Estimate | None:
        """RMS noise of the value of one query over the mean value; None of measured data: it is unknown."""
        arrays = self.samples[split]
        if "value_b" not in arrays:
            return None
        return pooled_relative_error(arrays["value_a"], arrays["value_b"], _weight(arrays))


def mean_of(arrays: Arrays) -> NDArray[np.float32]:
    """Values (..., 3): the mean of both estimates, or the only one."""
    first = arrays["value_a"]
    return np.float32(0.5) * first + np.float32(0.5) * arrays.get("value_b", first)


def _weight(arrays: Arrays) -> NDArray[np.float32] | None:
    """Weights (n,) of rows; None where they have none."""
    return arrays["weight"].reshape(len(arrays["weight"]), -1)[:, 0] if "weight" in arrays else None


def name_of(manifest: Mapping[str, Any]) -> str:
    """Name of the material of a data set."""
    path = Path(manifest["measured"]["file"] if "measured" in manifest else manifest["config"]["material"])
    found = path.stem if path.suffix else path.name
    if path.stem.lower() in _GENERIC:
        found = path.parent.name or found
    words = re.sub(r"[^\w.]+|_+", " ", found if found.isprintable() else "").strip()
    return words or "material"
