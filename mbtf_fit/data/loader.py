"""Loading of data sets: the train split, divided into training and held-out queries, and whole splits."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from mbtf_core.data.dataset import Dataset, Shard
from mbtf_core.data.schema import Split
from mbtf_core.errors import InputError
from mbtf_fit.data.layouts import TrainingImages, TrainingSlices, nearest_shapes, philox, strides
from mbtf_fit.data.queries import QUERY_BYTES, ShardQueries, TrainingQueries, mean_value, needed
from mbtf_fit.data.streaming import Selection, StreamedQueries
from mbtf_fit.sections import HeldOutSection

# Training queries that are kept with both halves, as a sample of all.
SAMPLE = 1 << 16
# Most held-out queries of each kind. Queries of one image are correlated, so the image layout keeps fewer.
MAX_HELD_OUT = 1 << 16
MAX_HELD_OUT_OF_IMAGES = 1 << 14
# Random stream of the image layout's split; the streams of its batches count up from 0.
SPLIT_STREAM = 1 << 62
# Labels of the rows of the train split.
TRAINING, HELD_OUT_QUERY, HELD_OUT_DIRECTION = np.int8(0), np.int8(1), np.int8(2)


@dataclass(frozen=True)
class Partition:
    """The train split, divided into training queries and held-out queries.

    Attributes
    ----------
    training : training queries in the order of the shards, streamed from disk where they exceed the memory
        limit; images in the image layout; slices of all texels in the slices layout
    held_out_queries : a random fraction of the queries outside the held-out region
    held_out_directions : queries with light or view in the held-out region; at most `MAX_HELD_OUT`
    sample : a sample of the training queries with both halves; about `SAMPLE` queries from all shards
    selection : rows of the shards that are trained on: queries, images or slices
    """

    training: TrainingQueries | TrainingImages | TrainingSlices | StreamedQueries
    held_out_queries: ShardQueries
    held_out_directions: ShardQueries
    sample: ShardQueries
    selection: Selection


def read_checked(shard: Shard) -> ShardQueries:
    """One shard, every number checked."""
    return ShardQueries.of(shard.read(needed(shard.estimates, shard.weighted)))


def in_region(held_out: HeldOutSection, omega: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Mask (n,) of the directions (n, 3) in the held-out region, a disk on the projected hemisphere."""
    if held_out.radius == 0:
        return np.zeros(len(omega), bool)
    center = np.asarray(held_out.direction, np.float32)
    with np.errstate(over="ignore"):  # of corrupt shards
        return ((omega[:, :2] - center) ** 2).sum(1) < np.float32(held_out.radius) ** 2


def label_queries(
    held_out: HeldOutSection, queries: ShardQueries, seed: int, shard: int, lights: int
) -> NDArray[np.int8]:
    """Label of each query of a shard. Both held-out sets are whole groups of `lights` queries, whose noise is
    correlated: errors of a fit to some of a group would seem small at the others. Queries beside one of the
    region are therefore held out, too."""
    groups = np.random.Generator(np.random.Philox(key=[seed, shard])).random(len(queries) // lights)
    random = np.tile(groups, lights)
    labels = np.where(random < held_out.queries, HELD_OUT_QUERY, TRAINING)
    region = in_region(held_out, queries.omega_i) | in_region(held_out, queries.omega_o)
    beside = np.tile(region.reshape(lights, -1).any(axis=0), lights)
    labels = np.where(beside, HELD_OUT_QUERY, labels)
    return np.where(region, HELD_OUT_DIRECTION, labels)


def label_images(data: Dataset, held_out: HeldOutSection, random: np.random.Generator) -> NDArray[np.int8]:
    """Label of each image of the train split. Where ``held_out.queries`` is not 0, at least one image is held
    out."""
    parts = []
    for shard in data.shards("train"):
        arrays = shard.read(("omega_i", "omega_o"))
        light, view = (np.array(arrays[name][:, 0, 0]) for name in ("omega_i", "omega_o"))
        parts.append(in_region(held_out, light) | in_region(held_out, view))
    labels = np.where(np.concatenate(parts), HELD_OUT_DIRECTION, TRAINING)
    _hold_out(labels, held_out.queries, random)
    return labels


def _hold_out(labels: NDArray[np.int8], share: float, random: np.random.Generator) -> None:
    """Label a share of the training rows as held out, at least one unless the share is 0."""
    inside = np.flatnonzero(labels == TRAINING)
    count = max(1, round(share * len(inside))) if share and len(inside) > 1 else 0
    labels[random.permutation(inside)[:count]] = HELD_OUT_QUERY


def sample_images(images: ShardQueries, most: int, random: np.random.Generator) -> ShardQueries:
    """At most `most` queries of images, equally many of each, in random order."""
    count, rows, columns = images.sigma.shape
    if count == 0:
        return images.flat()
    each = min(rows * columns, -(-most // count))
    chosen = [k * rows * columns + random.permutation(rows * columns)[:each] for k in range(count)]
    return images.flat().take(random.permutation(np.concatenate(chosen))[:most])


def load_training(
    data: Dataset, held_out: HeldOutSection, seed: int, memory: float | None = math.inf
) -> Partition:
    """Read the train split and divide it; the division depends on the data and `seed` alone.

    The image layout holds out whole images, the slices layout pairs of light and view.

    Parameters
    ----------
    memory : bytes that training queries may take; more are streamed from disk; None, of an evaluation,
        streams in any case, and accepts that all are held out, as in test sets with a single one

    Raises
    ------
    InputError : no queries to train on, NaN or infinity in a shard, corrupt shards; too many for memory, in
        shards that cannot be mapped
    """
    shards = data.shards("train")
    total = sum(shard.rows for shard in shards)
    if total == 0:
        raise InputError("its train split has no queries", where=data.folder, hint="generate more: --queries")
    if data.layout == "image":
        return _load_images(data, shards, held_out, seed)
    if data.layout == "slices":
        return _load_slices(data, shards, held_out, seed)
    streamed = memory is None or total * QUERY_BYTES > memory
    if memory is not None and streamed and any(shard.file.endswith(".exr") for shard in shards):
        raise InputError(
            f"its {total} queries take {total * QUERY_BYTES / 1e9:.3g} GB, more than data.memory allows, and "
            "EXR shards cannot be read in parts",
            where=data.folder,
            hint="raise data.memory, or generate with: mbtf-gen ... --format npz",
        )
    columns = {"u": (2,), "sigma": (), "omega_i": (3,), "omega_o": (3,), "value": (3,)}
    capacity = 0 if streamed else total
    store = {name: np.empty((capacity, *shape), np.float32) for name, shape in columns.items()}
    kept_out: tuple[list[ShardQueries], list[ShardQueries]] = ([], [])
    sample: list[ShardQueries] = []
    selection, lights = Selection(), data.lights_per_path("train")
    for index, shard in enumerate(shards):
        queries = read_checked(shard)
        labels = label_queries(held_out, queries, seed, index, lights)
        if lights > 1:
            # Numbers that no other shard has.
            paths = (index << 32) + np.tile(np.arange(len(queries) // lights), lights)
            queries = replace(queries, group=paths)
        for group, label in zip(kept_out, (HELD_OUT_QUERY, HELD_OUT_DIRECTION), strict=True):
            missing = MAX_HELD_OUT - sum(map(len, group))
            group.append(queries.take(np.flatnonzero(labels == label)[:missing]))
        selection.add(shard, labels == TRAINING)
        rows = np.flatnonzero(labels == TRAINING)
        # Shards store queries in random order, so the first ones are a random sample.
        sample.append(queries.take(rows[: -(-SAMPLE * len(rows) // total)]))
        if not streamed:
            part = slice(*selection.starts[-2:])
            for name in ("u", "sigma", "omega_i", "omega_o"):
                np.take(getattr(queries, name), rows, axis=0, out=store[name][part], mode="clip")
            store["value"][part] = mean_value(queries.value_a[rows], queries.value_b[rows])
    if len(selection) == 0 and memory is not None:
        raise _all_held_out(data, f"{total} queries")
    training: TrainingQueries | StreamedQueries = StreamedQueries(selection, estimates=data.estimates)
    if not streamed:
        training = TrainingQueries(**{n: torch.from_numpy(a[: len(selection)]) for n, a in store.items()})
    queries, directions, sampled = (ShardQueries.join(group) for group in (*kept_out, sample))
    return Partition(training, queries, directions, sampled, selection)


def _all_held_out(data: Dataset, what: str) -> InputError:
    return InputError(
        f"all {what} of its train split are held out",
        where=data.folder,
        hint="lower held_out.queries and held_out.radius",
    )


def _load_images(data: Dataset, shards: list[Shard], held_out: HeldOutSection, seed: int) -> Partition:
    """Read the train split of the image layout and divide it by images."""
    random = philox(seed, SPLIT_STREAM)
    labels = label_images(data, held_out, random)
    count = int((labels == TRAINING).sum())
    if count == 0:
        raise _all_held_out(data, f"{len(labels)} images")
    patch_size = data.patch_size
    shape = (count, *(data.lattice.shape() if patch_size is None else (patch_size, patch_size)))
    u, value = np.empty((*shape, 2), np.float32), np.empty((*shape, 3), np.float32)
    sigma, omega = np.empty(count, np.float32), np.empty((2, count, 3), np.float32)
    kept_out: tuple[list[ShardQueries], list[ShardQueries]] = ([], [])
    sample: list[ShardQueries] = []
    selection = Selection()
    read = 0
    for shard in shards:
        images = read_checked(shard)
        mine = labels[read : read + len(images)]
        read += len(images)
        for group, label in zip(kept_out, (HELD_OUT_QUERY, HELD_OUT_DIRECTION), strict=True):
            group.append(images.take(np.flatnonzero(mine == label)))
        kept = np.flatnonzero(mine == TRAINING)
        selection.add(shard, mine == TRAINING)
        sample.append(sample_images(images.take(kept), -(-SAMPLE * len(kept) // count), random))
        part = slice(*selection.starts[-2:])
        u[part], sigma[part] = images.u[kept], images.sigma[kept, 0, 0]
        omega[0, part], omega[1, part] = images.omega_i[kept, 0, 0], images.omega_o[kept, 0, 0]
        value[part] = mean_value(images.value_a[kept], images.value_b[kept])
    at, footprint, light, view, mean = map(torch.from_numpy, (u, sigma, *omega, value))
    step, extent = np.ones((count, 2), np.int64), None
    if patch_size is None:
        step = strides(data.lattice, sigma)
    else:
        extent = nearest_shapes(data.lattice, sigma)
    training = TrainingImages(at, footprint, light, view, mean, step, extent)
    queries, directions = (
        sample_images(ShardQueries.join(group), MAX_HELD_OUT_OF_IMAGES, random) for group in kept_out
    )
    return Partition(training, queries, directions, ShardQueries.join(sample), selection)


def _load_slices(data: Dataset, shards: list[Shard], held_out: HeldOutSection, seed: int) -> Partition:
    """Read the train split of the slices layout and divide it by pairs of light and view."""
    random = philox(seed, SPLIT_STREAM)
    first = shards[0].read(("sigma", "omega_i", "omega_o"))
    light, view = (np.array(first[name][0]) for name in ("omega_i", "omega_o"))
    region = in_region(held_out, light) | in_region(held_out, view)
    labels = np.where(region, HELD_OUT_DIRECTION, TRAINING)
    _hold_out(labels, held_out.queries, random)
    kept = np.flatnonzero(labels == TRAINING)
    if len(kept) == 0:
        raise _all_held_out(data, f"{len(labels)} pairs of light and view")
    value = np.full((data.lattice.texels(), len(kept), 3), np.nan, np.float32)
    kept_out: tuple[list[ShardQueries], list[ShardQueries]] = ([], [])
    sample: list[ShardQueries] = []
    selection = Selection()
    for shard in shards:
        slices = read_checked(shard)
        if (slices.omega_i != light).any() or (slices.omega_o != view).any():
            raise InputError("its slices do not share their directions", where=shard.where)
        for group, label in zip(kept_out, (HELD_OUT_QUERY, HELD_OUT_DIRECTION), strict=True):
            group.append(
                _pairs(slices, labels == label, MAX_HELD_OUT * len(slices) // value.shape[0] + 1, random)
            )
        sample.append(_pairs(slices, labels == TRAINING, SAMPLE * len(slices) // value.shape[0] + 1, random))
        selection.add(shard, np.ones(len(slices), bool))
        value[data.lattice.texel_of(slices.u[:, 0])] = mean_value(slices.value_a, slices.value_b)[:, kept]
    if np.isnan(value).any():
        raise InputError("lacks slices of some texels", where=data.folder, hint="generate the data set again")
    mean, omega_i, omega_o = (
        torch.from_numpy(np.ascontiguousarray(a)) for a in (value, light[kept], view[kept])
    )
    training = TrainingSlices(mean, omega_i, omega_o, float(first["sigma"][0, 0]))
    queries, directions = (ShardQueries.join(group) for group in kept_out)
    return Partition(training, queries, directions, ShardQueries.join(sample), selection)


def _pairs(
    slices: ShardQueries, chosen: NDArray[np.bool_], most: int, random: np.random.Generator
) -> ShardQueries:
    """At most `most` of the queries of slices (items, D) at the chosen directions (D,), in random order."""
    items, pairs = np.arange(len(slices)), np.flatnonzero(chosen)
    flat = (items[:, None] * slices.sigma.shape[1] + pairs).ravel()
    return slices.flat().take(random.permutation(flat)[:most])


def load_split(data: Dataset, split: Split) -> ShardQueries:
    """Queries of a split.

    Raises
    ------
    InputError : no such split, no queries in it, NaN or infinity, corrupt shards
    """
    parts = [read_checked(shard).flat() for shard in data.shards(split)]
    if not sum(map(len, parts)):
        raise InputError(f"its {split} split has no queries", where=data.folder)
    return ShardQueries.join(parts)
