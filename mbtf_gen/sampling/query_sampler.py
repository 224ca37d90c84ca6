"""Random 7D queries: position, footprint, light and view.

Positions are stratified: pass after pass over the finest level's texels in a new random order, one query at
a random point of each. Levels are stratified within a shard over the cumulative mixture. Directions are
uniform on the projected disk, ``r ≤ √(1 - cos²_min)``. All arithmetic is exactly rounded
(:mod:`~mbtf_gen.sampling.exact_math`), so queries are the same bits on every machine.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.lattice import Lattice
from mbtf_core.data.schema import Layout, Queries, SliceDirections
from mbtf_core.stats import level_groups
from mbtf_gen.sampling.exact_math import exp2, sincos_turns
from mbtf_gen.sampling.rng import Purpose, numpy_generator

F32 = NDArray[np.float32]
# sigma (n,), omega_i (n, 3) and omega_o (n, 3) of queries or images.
Footprints = tuple[F32, F32, F32]
# (angle to the normal in degrees, directions on that circle) of the BTF database Bonn 2003: Sattler, Sarlette
# and Klein, "Efficient and realistic visualization of cloth", EGSR 2003. The first of each circle has the
# azimuth 0.
_UBO2003 = ((0, 1), (15, 6), (30, 12), (45, 18), (60, 20), (75, 24))
UBO2003_COUNT = sum(count for _, count in _UBO2003)
UBO2003_LOWEST = math.cos(math.radians(_UBO2003[-1][0]))
# Turns between neighbors of the spiral: one minus the inverse of the golden ratio.
_GOLDEN = (3.0 - math.sqrt(5.0)) / 2.0


@dataclass(frozen=True)
class LevelMixture:
    """Mixture distribution of the fractional level; weights are normalized to sum 1.

    Attributes
    ----------
    log_uniform, finest : weights of l ~ U[0, k] and of l ~ U[k-1, k]
    """

    log_uniform: float
    finest: float

    def __post_init__(self) -> None:
        total = self.log_uniform + self.finest
        if not total > 0:
            raise ValueError("weights of the level mixture must not all be zero")
        object.__setattr__(self, "log_uniform", self.log_uniform / total)
        object.__setattr__(self, "finest", self.finest / total)

    def level(self, xi: NDArray[np.float64], finest: int) -> NDArray[np.float64]:
        """Fractional levels in [0, k] from numbers in [0, 1), by inversion of the cumulative distribution;
        `finest` is k."""
        first = xi < self.log_uniform
        low = max(finest - 1, 0)
        share = xi / self.log_uniform if self.log_uniform > 0 else xi
        rest = (xi - self.log_uniform) / self.finest if self.finest > 0 else xi
        return np.where(first, share * finest, low + rest * (finest - low))


def _rounded(u: NDArray[np.float64], v: NDArray[np.float64]) -> F32:
    """Positions (..., 2) in [0, 1)."""
    uv = np.stack([u, v], axis=-1).astype(np.float32)
    # Rounding to float32 can reach 1, which is 0 on the torus.
    return np.where(uv >= 1.0, np.float32(0.0), uv)


@dataclass(frozen=True)
class QueryPlan:
    """Sampler of the queries of each shard, independent of other shards.

    Attributes
    ----------
    lattice : texel grids of the tile
    mixture : distribution of the levels
    min_cos : smallest cosine of both directions to the normal, in (0, 1)
    layout : "shuffled", "image" or "slices"
    root : root seed
    shard_rows : queries (shuffled layout), images (image layout) or positions (slices layout) per full shard
    patch_size : texels along each side of an image, of the level nearest to its footprint; None: an image
        covers the finest level
    directions : (n, 3) float32 array
        Lights and views of the slices layout.
    lights : queries of a group, which share position, footprint and view
    """

    lattice: Lattice
    mixture: LevelMixture
    min_cos: float
    layout: Layout
    root: int
    shard_rows: int
    patch_size: int | None = None
    directions: F32 | None = None
    lights: int = 1

    def draw(self, split: str, shard: int, rows: int) -> Queries:
        """Sample `rows` queries (shuffled layout), images (image layout) or positions (slices layout) of a
        shard.

        The split is ``train``, ``test``, or a stream of :mod:`mbtf_gen.sampling.sobol`. Leading axes are
        ``(rows,)``, or ``(rows, height, width)`` of images. Slices are ``(rows, n²)``, one at the center of
        each texel of the finest level; those of other splits hold one query, as of the shuffled layout.

        With L lights the queries i, i + rows/L, i + 2 rows/L, … are a group, so that neighbors are
        independent; test queries have no groups.
        """
        if self.lights > 1 and split != "test":
            return self._groups(split, shard, rows)
        if self.layout == "slices" and split == "train":
            return self._slices(self._texels(split, shard * self.shard_rows, rows))
        generator = self.generator(split, shard)
        return self.place(generator, split, shard, self.footprints(generator, rows))

    def generator(self, split: str, shard: int) -> np.random.Generator:
        """Random numbers of a shard's queries."""
        return numpy_generator(self.root, split, shard, Purpose.QUERIES)

    def footprints(self, generator: np.random.Generator, rows: int) -> Footprints:
        """Sample footprints and directions."""
        sigma = self._sigma(generator, rows)
        omega_i = self._directions(generator, rows)
        return sigma, omega_i, self._directions(generator, rows)

    def place(
        self, generator: np.random.Generator, split: str, shard: int, footprints: Footprints
    ) -> Queries:
        """Sample positions for footprints and directions, see :meth:`draw`."""
        sigma, omega_i, omega_o = footprints
        rows = len(sigma)
        if self.layout != "image":
            texel = self._texels(split, shard * self.shard_rows, rows)
            found = Queries(self._positions(generator, texel), sigma, omega_i, omega_o)
            return found if self.layout == "shuffled" else found.take((slice(None), None))
        if self.patch_size is None:
            shape = (rows, *self.lattice.shape())
            texel = np.broadcast_to(np.arange(self.lattice.texels()).reshape(shape[1:]), shape)
            positions = self._positions(generator, texel)
        else:
            positions = self._patch(generator, sigma, self.patch_size)

        def per_texel(of_image: F32) -> F32:
            shape = (*positions.shape[:3], *of_image.shape[1:])
            return np.ascontiguousarray(np.broadcast_to(of_image[:, None, None], shape))

        return Queries(positions, per_texel(sigma), per_texel(omega_i), per_texel(omega_o))

    def _texels(self, split: str, start: int, count: int) -> NDArray[np.int64]:
        """Texels of the queries start … start+count-1 of a split: a new random order for every pass."""
        texels = self.lattice.texels()
        first = start // texels
        orders = [
            numpy_generator(self.root, split, sweep, Purpose.TEXEL_ORDER).permutation(texels)
            for sweep in range(first, -(-(start + count) // texels))
        ]
        return np.concatenate(orders)[start - first * texels :][:count]

    def _groups(self, split: str, shard: int, rows: int) -> Queries:
        count = self.lights
        alone = replace(self, lights=1, shard_rows=self.shard_rows // count)
        views = alone.draw(split, shard, rows // count)
        light = self._directions(numpy_generator(self.root, split, shard, Purpose.LIGHTS), rows)
        return Queries(
            np.tile(views.u, (count, 1)),
            np.tile(views.sigma, count),
            light,
            np.tile(views.omega_o, (count, 1)),
        )

    def _slices(self, texel: NDArray[np.int64]) -> Queries:
        """All pairs of light and view at the centers of texels (n,), with the finest footprint."""
        assert self.directions is not None
        light, view = direction_pairs(self.directions)
        shape = (len(texel), len(light))
        rows, columns = self.lattice.shape()
        j, i = np.divmod(texel, columns)
        center = _rounded((i + 0.5) / columns, 1.0 - (j + 0.5) / rows)
        sigma = np.full(shape, np.float32(self.lattice.sigma_range[0]), np.float32)
        return Queries(
            np.broadcast_to(center[:, None], (*shape, 2)).copy(),
            sigma,
            np.broadcast_to(light, (*shape, 3)).copy(),
            np.broadcast_to(view, (*shape, 3)).copy(),
        )

    def _patch(self, generator: np.random.Generator, sigma: F32, size: int) -> F32:
        """Texel positions (n, size, size, 2): patches of the level nearest to footprints (n,), at random
        offsets, wrapped around the tile."""
        shapes = np.array([self.lattice.shape(s) for s in range(self.lattice.finest + 1)])
        extent = shapes[level_groups(sigma, self.lattice.finest)]
        start = generator.random((len(sigma), 2, 1))
        down, across = (start[:, k] + np.arange(size) / extent[:, k, None] for k in (0, 1))
        return _rounded(*np.broadcast_arrays(across[:, None] % 1.0, 1 - down[:, :, None] % 1.0))

    def _positions(self, generator: np.random.Generator, texel: NDArray[np.int64]) -> F32:
        rows, columns = self.lattice.shape()
        j, i = np.divmod(texel, columns)
        jitter = generator.random((*texel.shape, 2))
        u = (i + jitter[..., 0]) / columns
        v = 1.0 - (j + jitter[..., 1]) / rows
        return _rounded(u, v)

    def _sigma(self, generator: np.random.Generator, rows: int) -> F32:
        strata = (generator.permutation(rows) + generator.random(rows)) / rows
        level = self.mixture.level(strata, self.lattice.finest)
        low, high = (np.float32(s) for s in self.lattice.sigma_range)
        return np.clip((0.5 * exp2(-level)).astype(np.float32), low, high)

    def _directions(self, generator: np.random.Generator, rows: int) -> F32:
        radius2 = generator.random(rows) * ((1.0 - self.min_cos) * (1.0 + self.min_cos))
        sine, cosine = sincos_turns(generator.random(rows))
        radius = np.sqrt(radius2)
        return np.stack([radius * cosine, radius * sine, np.sqrt(1.0 - radius2)], axis=-1).astype(np.float32)


def slice_directions(kind: SliceDirections, count: int, min_cos: float) -> F32:
    """Directions (n, 3) of a slice, n = `count` for the spiral and 81 for ``ubo2003``.

    The spiral covers the projected disk down to the cosine `min_cos` with equal density (Vogel 1979).
    """
    if kind == "ubo2003":
        angle = np.repeat([a for a, _ in _UBO2003], [n for _, n in _UBO2003]) / 360.0
        turns = np.concatenate([np.arange(n) / n for _, n in _UBO2003])
        sine, z = sincos_turns(angle)
    else:
        sine2 = (np.arange(count) + 0.5) / count * ((1.0 - min_cos) * (1.0 + min_cos))
        sine, z = np.sqrt(sine2), np.sqrt(1.0 - sine2)
        turns = np.arange(count) * _GOLDEN % 1.0
    s, c = sincos_turns(turns)
    return np.stack([sine * c, sine * s, z], axis=-1).astype(np.float32)


def direction_pairs(directions: F32) -> tuple[F32, F32]:
    """Lights and views (n², 3) of a slice: every view under the first light, then under the next."""
    count = len(directions)
    return np.repeat(directions, count, axis=0), np.tile(directions, (count, 1))
