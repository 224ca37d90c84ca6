"""Monte Carlo estimates of M at queries: two independent halves per query.

The paths of a launch are sorted by position on the reference plane and by the elevations of view and light,
so that neighboring lanes take about as many traversal steps. The random numbers of a path depend only on its
number in the shard, so values do not depend on how queries are grouped into launches.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.documents import BadSample
from mbtf_core.data.schema import Queries
from mbtf_core.directions import check_unit
from mbtf_core.errors import PartialError
from mbtf_gen.engine.types import Color3f, Float, Float64, Point2f, Ray3f, UInt32, padded
from mbtf_gen.render.directional_light import DirectionalLight
from mbtf_gen.render.estimates import MOST_LOCATED, Estimates, Stream
from mbtf_gen.render.path_tracer import PathTracer, Transport
from mbtf_gen.render.scene import CLEARANCE, TileScene
from mbtf_gen.sampling.light_kernel import LightKernel
from mbtf_gen.sampling.rng import Purpose, stream_key, stream_number
from mbtf_gen.sampling.sobol import SobolSampler, sequence

# Paths per launch: enough to fill any machine, few enough to fit into memory.
LAUNCH_PATHS = 1 << 20
# Paths of the first launch. Launches grow twofold while one takes less than the first time, in seconds, and
# shrink after one that takes longer than the second.
FIRST_LAUNCH = 1 << 15
_SHORT, _LONG = 2.0, 8.0
# Passes in which non-finite samples are drawn again before the run stops.
MAX_RESAMPLES = 4


class RaySource(Protocol):
    """Source of first rays: the query sensor, or a camera's pixels."""

    def set_queries(self, queries: Queries, first: int = 0) -> None:
        """Set a batch of queries; `first` is the number of its first query."""

    def footprint(self, query: UInt32, xi: Point2f) -> Point2f:
        """uv of a point of the queries' footprints, not wrapped."""

    def ray(self, query: UInt32, point: Point2f) -> Ray3f:
        """Ray through such a point, in scene units."""


class Estimator:
    """Monte Carlo estimator of M on one tile.

    Parameters
    ----------
    tile : the displaced tile, see :func:`~mbtf_gen.render.scene.build_scene`
    light : smoothed directional light; None for constant radiance 1, from below as well where rays can pass
        through the tile (white furnace)
    transport : effects that are simulated
    launch : paths per kernel launch at most; does not change the values

    Attributes
    ----------
    holes : whether rays can pass through the tile, so that the transmittance is estimated
    observe : called with the paths of each launch once it is traced
    """

    def __init__(
        self, tile: TileScene, light: LightKernel | None, transport: Transport, launch: int = LAUNCH_PATHS
    ) -> None:
        self.tile = tile
        self.light = light
        self.transport = transport
        self.launch = launch
        self.observe: Callable[[int], None] = lambda paths: None
        self._size = FIRST_LAUNCH
        self.holes = bool(tile.surface.parts.opacity) or tile.geometry.open
        self._sensor = mi.load_dict(
            {"type": "mbtf_queries", "unit": tile.unit, "aspect": tile.aspect, "start": CLEARANCE}
        )

    def estimate(
        self,
        queries: Queries,
        spp: int | NDArray[np.int64],
        stream: Stream,
        source: RaySource | None = None,
        limit: int | None = None,
        roulette: int | None = None,
        path_variance: bool = False,
    ) -> Estimates:
        """Estimate M at queries.

        Parameters
        ----------
        queries : Queries
            n queries, with one leading axis.
        spp : int or (n,) int64 array; paths per query, both halves together; even
        stream : random numbers to use
        source : source of the first rays; the query sensor by default
        limit : largest number of surface interactions of a path; that of the transport by default
        roulette : interactions before Russian roulette starts; that of the transport by default
        path_variance : also estimate the sample variance of single paths

        Returns
        -------
        Estimates
            Values of both halves in 1/sr, with counts of lost and non-finite samples.

        Raises
        ------
        ValueError : a number of paths is odd or zero
        InputError : a direction is not a unit vector
        PartialError : samples stay non-finite after several draws; says which query and which effect
        """
        check_unit(queries.omega_i, "omega_i")
        check_unit(queries.omega_o, "omega_o")
        counts = np.full(len(queries.sigma), spp, np.int64) if isinstance(spp, int) else spp
        if counts.min() < 2 or (counts % 2).any():
            raise ValueError(f"spp must be even, for two equal halves, not {spp}")
        most = dr.opaque(mi.UInt32, self.transport.limit if limit is None else limit)
        late = dr.opaque(mi.UInt32, self.transport.roulette_depth if roulette is None else roulette)
        parts = [
            _Launch(
                self, queries.take(rows), rows.start, counts[rows], stream, source or self._sensor, most, late
            ).estimates(path_variance)
            for rows in self._launches(counts)
        ]

        def joined(name: str) -> Any:
            arrays = [getattr(p, name) for p in parts]
            return None if arrays[0] is None else np.concatenate(arrays)

        return Estimates(
            joined("value_a"),
            joined("value_b"),
            joined("transmittance"),
            int(counts.sum()),
            sum(p.lost for p in parts),
            sum(p.capped for p in parts),
            sum(p.nonfinite for p in parts),
            tuple(b for p in parts for b in p.bad_samples)[:MOST_LOCATED],
            spp=None if isinstance(spp, int) else counts,
            path_variance=joined("path_variance"),
        )

    def _launches(self, counts: NDArray[np.int64]) -> Iterator[slice]:
        """Consecutive queries to trace in one launch: few enough that each ends soon; one query at least."""
        ends = np.cumsum(counts)
        start, traced = 0, 0
        while start < len(counts):
            size = min(self._size, self.launch)
            stop = max(start + 1, int(np.searchsorted(ends, traced + size, side="right")))
            began = time.perf_counter()
            yield slice(start, stop)
            seconds = time.perf_counter() - began
            paths = int(ends[stop - 1]) - traced
            if seconds > _LONG:
                self._size = max(FIRST_LAUNCH, size // 2)
            elif seconds < _SHORT and paths > size // 2:
                self._size = 2 * size
            start, traced = stop, int(ends[stop - 1])
            self.observe(paths)


class _Launch:
    """All paths of consecutive queries, one lane per path, one query after the other.

    Parameters
    ----------
    queries : the launch's queries; first : number of the first of them in the shard
    counts : (n,) paths of each query
    limit, roulette : as of :class:`~mbtf_gen.render.path_tracer.PathTracer`
    """

    def __init__(
        self,
        estimator: Estimator,
        queries: Queries,
        first: int,
        counts: NDArray[np.int64],
        stream: Stream,
        source: RaySource,
        limit: UInt32,
        roulette: UInt32,
    ) -> None:
        self.estimator, self.first, self.counts, self.stream = estimator, first, counts, stream
        self.source, self.limit, self.roulette = source, limit, roulette
        source.set_queries(queries, first)
        self.lights = DirectionalLight.of(estimator.light, queries.omega_i)
        # First lane of each query, and the paths of one half of it.
        self.starts = np.cumsum(counts) - counts
        self.start, self.half = _aligned(self.starts), _aligned(counts // 2)
        # Query of each lane.
        self.query = _aligned(np.repeat(np.arange(len(counts), dtype=np.uint32), counts))
        # Lower half of the sorting key: 4 bits each of the cosines of ω_o and ω_i.
        view, light = (
            np.clip(16.0 * w[:, 2], 0, 15).astype(np.uint32) for w in (queries.omega_o, queries.omega_i)
        )
        self.direction_key = _aligned(view << 4 | light)

    def estimates(self, path_variance: bool) -> Estimates:
        """Estimates of the queries; samples that are not finite are drawn again."""
        radiance, passed, lost, capped = self._trace()
        values = self._halves(radiance)
        # Few launches have non-finite samples: their lanes are searched only then.
        bad = np.zeros(0, np.uint32) if np.isfinite(values).all() else _nonfinite(radiance)
        located = self._located(bad[:MOST_LOCATED])
        nonfinite = len(bad)
        for attempt in range(1, MAX_RESAMPLES + 1):
            if not len(bad):
                break
            lanes = mi.UInt32(padded(bad))
            again, through, more_lost, more_capped = self._trace(lanes, attempt)
            dr.scatter(radiance, again, lanes)
            if self.estimator.holes:
                dr.scatter(passed, through, lanes)
            dr.eval(radiance, passed)
            lost, capped = lost + more_lost, capped + more_capped
            bad = bad[_nonfinite(again)]
            nonfinite += len(bad)
        if len(bad):
            raise PartialError(
                f"{len(bad)} samples stay NaN or infinite after {MAX_RESAMPLES} draws, first at "
                f"query {self._number(bad[0])} ({located[0].effect})",
                where=f"{self.stream.split} shard {self.stream.shard}",
                hint="check the material's values",
            )
        if nonfinite:
            values = self._halves(radiance)
        return Estimates(
            values[:, 0].astype(np.float32),
            values[:, 1].astype(np.float32),
            self._halves(passed).mean(axis=(1, 2)).astype(np.float32) if self.estimator.holes else None,
            int(self.counts.sum()),
            lost,
            capped,
            nonfinite,
            located,
            path_variance=self._variances(radiance, values) if path_variance else None,
        )

    def _number(self, lane: int) -> int:
        """Number of a lane's query in the shard."""
        return self.first + int(np.searchsorted(self.starts, lane, side="right")) - 1

    def _halves(self, x: Float | Color3f) -> NDArray[np.float64]:
        """Mean of each half of each query, (n, 2, channels), of one number or color per lane."""
        which = dr.arange(mi.UInt32, 2 * len(self.counts))
        query, second = which >> 1, which & 1
        half = dr.gather(mi.UInt32, self.half, query)
        begin = dr.gather(mi.UInt32, self.start, query) + second * half
        totals = [_sum_of(channel, begin, begin + half) for channel in (x if dr.depth_v(x) == 2 else [x])]
        dr.eval(totals)
        total = np.stack([np.array(t) for t in totals], axis=-1)
        return total.reshape(len(self.counts), 2, -1) / (self.counts // 2)[:, None, None]

    def _variances(self, radiance: Color3f, values: NDArray[np.float64]) -> NDArray[np.float32]:
        """Sample variance of each query's paths, mean over channels."""
        square = self._halves(dr.squared_norm(radiance)).mean(axis=(1, 2)) / 3.0
        spread = square - np.mean(values.mean(axis=1) ** 2, axis=-1)
        return np.maximum(spread * self.counts / (self.counts - 1), 0.0).astype(np.float32)

    def _located(self, bad: NDArray[np.uint32]) -> tuple[BadSample, ...]:
        """Queries of non-finite lanes, and the effect at fault: direct light, if their paths are non-finite
        after one interaction."""
        if not len(bad):
            return ()
        direct = _nonfinite(self._trace(mi.UInt32(padded(bad)), limit=dr.opaque(mi.UInt32, 1))[0])
        return tuple(
            BadSample(self._number(lane), "direct light" if k in direct else "interreflection")
            for k, lane in enumerate(bad)
        )

    def _points(self, lane: UInt32, query: UInt32, purpose: Purpose, attempt: int) -> SobolSampler:
        """Random numbers of paths."""
        path = lane - dr.gather(mi.UInt32, self.start, query)
        half = dr.gather(mi.UInt32, self.half, query)
        second = path >= half
        # Both halves take the same points, of differently scrambled sequences.
        s, number = self.stream, self.stream.first_pass + attempt
        keys = [stream_key(s.root, stream_number(s.split, s.shard, purpose, number, h)) for h in (1, 0)]
        low, high = (
            dr.select(second, *(dr.opaque(mi.UInt32, key >> shift & 0xFFFFFFFF) for key in keys))
            for shift in (0, 32)
        )
        of_shard = query + dr.opaque(mi.UInt32, self.first)
        return sequence(low, high, of_shard, dr.select(second, path - half, path))

    def _trace(
        self, which: UInt32 | None = None, attempt: int = 0, limit: UInt32 | None = None
    ) -> tuple[Color3f, Float, int, int]:
        """Radiance of some of the lanes (all, if None); where rays can pass, 1 where the first ray was
        transmitted; counts of lost and capped rays."""
        everything = which is None
        if everything:
            which, query = dr.arange(mi.UInt32, int(self.counts.sum())), self.query
        else:
            query = dr.gather(mi.UInt32, self.query, which)
        xi = self._points(which, query, Purpose.FOOTPRINT, attempt).next_2d()
        point = self.source.footprint(query, xi)
        key = _position_key(point) | dr.gather(mi.UInt32, self.direction_key, query)
        dr.eval(point, key)
        order = _aligned(np.argsort(np.array(key).astype(np.uint16), kind="stable"))

        lane = order if everything else dr.gather(mi.UInt32, which, order)
        query = dr.gather(mi.UInt32, self.query, lane)
        tracer = PathTracer(
            self.estimator.tile,
            self.estimator.transport,
            self.lights.at(query),
            self.limit if limit is None else limit,
            self.roulette,
        )
        ray = self.source.ray(query, dr.gather(mi.Point2f, point, order))
        path = tracer.trace(ray, self._points(lane, query, Purpose.PATH, attempt))
        radiance = dr.zeros(mi.Color3f, dr.width(which))
        dr.scatter(radiance, path.radiance, order)
        passed = None
        if self.estimator.holes:
            passed = dr.zeros(mi.Float, dr.width(which))
            dr.scatter(passed, dr.select(path.passed, 1.0, 0.0), order)
        dr.eval(radiance, passed, path.lost, path.capped)
        return radiance, passed, int(dr.count(path.lost)[0]), int(dr.sum(path.capped)[0])


def _nonfinite(radiance: Color3f) -> NDArray[np.uint32]:
    """Lanes of colors that are NaN or infinite."""
    finite = dr.isfinite(radiance.x) & dr.isfinite(radiance.y) & dr.isfinite(radiance.z)
    if dr.all(finite)[0]:
        return np.zeros(0, np.uint32)
    return np.nonzero(~np.array(finite))[0].astype(np.uint32)


def _position_key(point: Point2f) -> UInt32:
    """Upper half of a path's sorting key: 8 bits of a Morton curve over the tile."""
    cell = mi.Vector2u((point - dr.floor(point)) * 16.0)

    def spread(x: UInt32) -> UInt32:
        x = (x | (x << 2)) & 0x33
        return (x | (x << 1)) & 0x55

    return (spread(cell.x) | (spread(cell.y) << 1)) << 8


def _aligned(numbers: NDArray[Any]) -> UInt32:
    """Lane numbers as a copy: NumPy's memory is aligned or not by chance, and kernels would be compiled for
    either case."""
    copied = mi.UInt32(padded(numbers.astype(np.uint32))) + dr.opaque(mi.UInt32, 0)
    dr.eval(copied)
    return copied


@dr.syntax
def _sum_of(x: Float, lane: UInt32, end: UInt32) -> Float64:
    """Sums over ranges of lanes, in order, so that they do not depend on threads or launches."""
    total, lane = mi.Float64(0.0), mi.UInt32(lane)
    while dr.hint(lane < end, exclude=[x, end]):
        total += mi.Float64(dr.gather(mi.Float, x, lane))
        lane += 1
    return total
