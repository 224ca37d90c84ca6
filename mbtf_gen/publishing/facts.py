"""What a manifest says of a data set, in the words of its card and of ``croissant.json``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from mbtf_core.data.dataset import Dataset, Shard
from mbtf_gen.config.publish import PublishConfig

# Folder of the shards.
DATA = "data"
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
    """A data set that is published, and what its publishers say.

    Attributes
    ----------
    data : Dataset
        The data set.
    config : PublishConfig
        What the publishers say.
    """

    data: Dataset
    config: PublishConfig

    @property
    def measured(self) -> Mapping[str, Any] | None:
        """What the manifest says of measured data; None of generated ones."""
        return self.data.manifest.get("measured")

    @property
    def name(self) -> str:
        """Name of the data set: the given one, else that of the material."""
        if self.config.name is not None:
            return self.config.name
        path = Path(self.measured["file"] if self.measured else self.data.manifest["config"]["material"])
        found = path.stem if path.suffix else path.name
        if path.stem.lower() in _GENERIC:
            found = path.parent.name
        words = re.sub(r"[^\w.]+|_+", " ", found if found.isprintable() else "").strip()
        return words or "material"

    @property
    def summary(self) -> str:
        """One sentence about the data set, of plain text."""
        splits = self.data.manifest["splits"]
        counts = " and ".join(
            f"{splits[name]['queries']:,} {'training' if name == 'train' else name}" for name in self.shards
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

    @cached_property
    def shards(self) -> dict[str, list[Shard]]:
        """Shards of each split that has any."""
        found = {split: self.data.shards(split) for split in self.data.splits}
        return {split: shards for split, shards in found.items() if shards}

    @cached_property
    def shapes(self) -> dict[str, dict[str, tuple[int, ...]]]:
        """Shape of one row of each array of each split."""
        return {
            split: {name: array.shape[1:] for name, array in shards[0].read().items()}
            for split, shards in self.shards.items()
        }

    @property
    def same_shapes(self) -> bool:
        """Whether rows of all splits have the same shapes."""
        shapes = list(self.shapes.values())
        return all(shape == shapes[0] for shape in shapes)
