"""Read a data set with NumPy alone: ``python examples/read_data.py shards/``."""

import json
import sys
from pathlib import Path

import numpy as np


def read_split(folder, split):
    """Arrays of a split by name; the first axis counts queries, or images in the image layout."""
    manifest = json.loads((Path(folder) / "manifest.json").read_text())
    if (manifest["format"], manifest["schema"]) != ("mbtf-shards", 5) or not manifest["complete"]:
        raise ValueError(f"{folder} holds no complete data set of schema 5")
    shards = [np.load(Path(folder) / s["file"]) for s in manifest["splits"][split]["shards"]]
    return {name: np.concatenate([shard[name] for shard in shards]) for name in manifest["arrays"]}


if __name__ == "__main__":
    for name, array in read_split(sys.argv[1], "test").items():
        print(name, array.shape, array.mean())
