"""Read a data set with NumPy alone: ``python examples/read_data.py shards/``."""

import json
import sys
from pathlib import Path

import numpy as np


def read_split(folder, split):
    """Arrays of a split by name; the first axis counts queries, or images in the image layout."""
    manifest = json.loads((Path(folder) / "manifest.json").read_text())
    if (manifest["format"], manifest["schema"]) != ("mbtf-shards", 6) or not manifest["complete"]:
        raise ValueError(f"{folder} holds no complete data set of schema 6")
    shards = [np.load(Path(folder) / s["file"]) for s in manifest["splits"][split]["shards"]]
    # Only test queries have weights.
    return {name: np.concatenate([shard[name] for shard in shards]) for name in shards[0]}


if __name__ == "__main__":
    test = read_split(sys.argv[1], "test")
    weight = test.get("weight", np.ones_like(test["sigma"])).ravel()
    for name, array in test.items():
        print(name, array.shape, np.average(array.reshape(len(weight), -1).mean(1), weights=weight))
