"""What the manifest of a data set says, in the words of its card."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.shard_files import Arrays
from mbtf_gen.config.publish import PublishConfig
from mbtf_gen.effects.catalog import EFFECTS

# Upper ends of the size categories of data hubs.
_SIZES = (
    *((1e3, "n<1K"), (1e4, "1K<n<10K"), (1e5, "10K<n<100K"), (1e6, "100K<n<1M"), (1e7, "1M<n<10M")),
    *((1e8, "10M<n<100M"), (1e9, "100M<n<1B"), (1e10, "1B<n<10B"), (1e11, "10B<n<100B"), (1e12, "100B<n<1T")),
)
_LAYOUTS = {
    "shuffled": "one query; rows are in random order",
    "image": "one image of queries that share light, view and footprint",
    "slices": "one position under all pairs of lights and views, or one query of the test split",
}
TAGS = (
    *("btf", "mbtf", "brdf", "reflectance", "appearance", "material", "rendering", "computer-graphics"),
    *("neural-materials", "level-of-detail"),
)
# Why a file name alone names no material.
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
    def manifest(self) -> dict[str, Any]:
        """The manifest of the data set."""
        return self.data.manifest

    @property
    def measured(self) -> Mapping[str, Any] | None:
        """What the manifest says of measured data; None of generated ones."""
        return self.manifest.get("measured")

    @property
    def name(self) -> str:
        """Name of the data set: the given one, else that of the material."""
        if self.config.name is not None:
            return self.config.name
        path = Path(self.measured["file"] if self.measured else self.manifest["config"]["material"])
        found = path.stem if path.suffix and path.stem.lower() not in _GENERIC else path.name
        if path.stem.lower() in _GENERIC:
            found = path.parent.name
        words = re.sub(r"[^\w.]+|_+", " ", found if found.isprintable() else "").strip()
        return words or "material"

    @property
    def slug(self) -> str:
        """The name as an identifier."""
        return re.sub(r"[^A-Za-z0-9]+", "-", self.name).strip("-").lower()[:200] or "material"

    @property
    def queries(self) -> dict[str, int]:
        """Number of queries of each split that has any."""
        splits = self.manifest["splits"]
        return {name: int(splits[name]["queries"]) for name in self.data.splits if splits[name]["shards"]}

    @property
    def size_category(self) -> str:
        """Size category of data hubs, by the number of rows."""
        rows = sum(entry.rows for split in self.data.splits for entry in self.data.entries(split))
        return next((name for most, name in _SIZES if rows < most), "n>1T")

    @property
    def layout(self) -> str:
        """What one row is."""
        return _LAYOUTS[self.data.layout]

    @property
    def summary(self) -> str:
        """One sentence about the data set, of plain text."""
        counts = " and ".join(
            f"{n:,} {'training' if name == 'train' else name}" for name, n in self.queries.items()
        )
        how = "measured" if self.measured else "path-traced"
        return (
            f"Multi-resolution bidirectional texture function (MBTF) of one material tile: {counts} queries "
            f"of {how} reflectance with position, footprint, direction of light and direction of view."
        )

    def fields(self, arrays: Arrays) -> dict[str, dict[str, Any]]:
        """``unit``, ``meaning`` and ``shape`` of one row of each array of a shard."""
        described = self.manifest["arrays"]
        return {
            name: {
                "unit": str(described[name]["unit"]),
                "meaning": str(described[name]["meaning"]),
                "shape": tuple(int(n) for n in array.shape[1:]),
            }
            for name, array in arrays.items()
        }

    @property
    def effects(self) -> list[tuple[str, str, str, str]]:
        """(effect, simulated or not, bias without it, why) of each effect of the plan."""
        plan = self.manifest.get("effects") or {"effects": []}
        return [
            (
                EFFECTS[e["name"]].description if e["name"] in EFFECTS else e["name"],
                "simulated" if e["on"] else "left out" if e["present"] else "not present",
                bound_text(e["bias_bound"], e["error"]) if e["present"] else "",
                e["explanation"],
            )
            for e in plan["effects"]
        ]


def bound_text(bound: float | None, error: float) -> str:
    """A bias bound with its standard error, in percent of the mean value."""
    if bound is None:
        return "not measured"
    return f"{100 * bound:.2g} %" if not error else f"{100 * bound:.2g} ± {100 * error:.1g} %"
