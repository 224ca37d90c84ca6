"""Division of the train split into training queries and held-out queries."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbtf_fit.config import HeldOutSection
from mbtf_fit.data.images import TrainingImages
from mbtf_fit.data.queries import ShardQueries, TrainingQueries
from mbtf_fit.data.streaming import Selection, StreamedQueries
from mbtf_gen.dataset.reader import Dataset
from mbtf_gen.dataset.shard_io import read_shard

# Training queries that are kept with both halves, as a sample of all.
SAMPLE = 1 << 16
# Most held-out queries of each kind. Queries of one image are correlated, so the image layout keeps fewer.
MAX_HELD_OUT = 1 << 16
MAX_HELD_OUT_OF_IMAGES = 1 << 14
# Random stream of the image layout's split; the streams of its batches count up from 0.
SPLIT_STREAM = 1 << 62
# Labels of the split.
TRAINING, HELD_OUT_QUERY, HELD_OUT_DIRECTION = np.int8(0), np.int8(1), np.int8(2)


@dataclass(frozen=True)
class Partition:
    """The train split, divided by :func:`~mbtf_fit.data.loader.load_training`.

    Attributes
    ----------
    training : training queries in the order of the shards; images in the image layout; streamed from disk
        where they exceed the memory limit
    held_out_queries : a random fraction of the queries outside the held-out region
    held_out_directions : queries with light or view in the held-out region; at most `MAX_HELD_OUT`
    sample : a sample of the training queries with both halves; about `SAMPLE` queries from all shards
    selection : rows of the shards that are trained on: queries, or images in the image layout
    """

    training: TrainingQueries | TrainingImages | StreamedQueries
    held_out_queries: ShardQueries
    held_out_directions: ShardQueries
    sample: ShardQueries
    selection: Selection


def in_region(held_out: HeldOutSection, omega: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Mask (n,) of the directions (n, 3) in the held-out region, a disk on the projected hemisphere."""
    if held_out.radius == 0:
        return np.zeros(len(omega), bool)
    center = np.asarray(held_out.direction, np.float32)
    with np.errstate(over="ignore"):  # of corrupt shards
        return ((omega[:, :2] - center) ** 2).sum(1) < np.float32(held_out.radius) ** 2


def label_queries(held_out: HeldOutSection, queries: ShardQueries, seed: int, shard: int) -> NDArray[np.int8]:
    """Label of each query of a shard."""
    random = np.random.Generator(np.random.Philox(key=[seed, shard])).random(len(queries))
    labels = np.where(random < held_out.queries, HELD_OUT_QUERY, TRAINING)
    region = in_region(held_out, queries.omega_i) | in_region(held_out, queries.omega_o)
    return np.where(region, HELD_OUT_DIRECTION, labels)


def label_images(data: Dataset, held_out: HeldOutSection, random: np.random.Generator) -> NDArray[np.int8]:
    """Label of each image of the train split. Where ``held_out.queries`` is not 0, at least one image is held
    out."""
    parts = []
    for shard in data.shards("train"):
        arrays = read_shard(shard.path, ("omega_i", "omega_o"))
        light, view = (np.array(arrays[name][:, 0, 0]) for name in ("omega_i", "omega_o"))
        parts.append(in_region(held_out, light) | in_region(held_out, view))
    labels = np.where(np.concatenate(parts), HELD_OUT_DIRECTION, TRAINING)
    inside = np.flatnonzero(labels == TRAINING)
    count = max(1, round(held_out.queries * len(inside))) if held_out.queries and len(inside) > 1 else 0
    labels[random.permutation(inside)[:count]] = HELD_OUT_QUERY
    return labels


def sample_images(images: ShardQueries, most: int, random: np.random.Generator) -> ShardQueries:
    """At most `most` queries of images, equally many of each, in random order."""
    count, rows, columns = images.sigma.shape
    if count == 0:
        return images.flat()
    each = min(rows * columns, -(-most // count))
    chosen = [k * rows * columns + random.permutation(rows * columns)[:each] for k in range(count)]
    return images.flat().take(random.permutation(np.concatenate(chosen))[:most])
