"""Small data sets to publish, and what others read of the published folders."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.dataset import Dataset
from mbtf_gen.config.exchange import PublishConfig
from mbtf_gen.publishing.publication import Publication

from .datasets import write_dataset

LAYOUTS: dict[str, dict[str, Any]] = {
    "shuffled": {"train": "300", "test": "40"},
    "image": {"train": "600", "test": "100", "layout": "image", "patch_size": 5},
    "slices": {"train": "9/texel", "test": "40", "layout": "slices"},
}


def small(folder: Path, layout: str = "shuffled") -> Dataset:
    """A data set of several shards, of a tile of 4 × 8 texels."""
    return write_dataset(folder, queries=LAYOUTS[layout], output={"shard_queries": 150})


def publish(shards: Path, output: Path, **options: Any) -> Path:
    """Publish a data set under CC0-1.0."""
    config = PublishConfig.model_validate({"license": "CC0-1.0", **options})
    Publication.prepare(shards, config).write(output)
    return output


def stored(folder: Path, split: str) -> dict[str, NDArray[np.float32]]:
    """Arrays of a split as NumPy alone reads them from the shards."""
    shards = [np.load(path) for path in sorted(folder.glob(f"{split}-*.npz"))]
    return {name: np.concatenate([shard[name] for shard in shards]) for name in shards[0].files}


def contents(folder: Path) -> dict[str, bytes]:
    """Content of each file by its name in the folder."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def python_blocks(card: str) -> list[str]:
    """Blocks of Python of a data card."""
    return re.findall(r"^```python\n(.*?)^```", card, re.DOTALL | re.MULTILINE)
