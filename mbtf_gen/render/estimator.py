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
from mbtf_gen.render.group_tracer import GroupTracer
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
        lights: int = 1,
    ) -> Estimates:
        """Estimate M at queries.

        Parameters
        ----------
        queries : Queries
            n queries, with one leading axis.
        spp : int or (n,) int64 array; paths per query, both halves together; even, equal within a group
        stream : random numbers to use
        source : source of the first rays; the query sensor by default
        limit : largest number of surface interactions of a path; that of the transport by default
        roulette : interactions before Russian roulette starts; that of the transport by default
        path_variance : also estimate the sample variance of single paths
        lights : L queries i, i + n/L, i + 2n/L, … are a group with one position, footprint and view, whose
            lights share the group's paths

        Raises
        ------
        ValueError : a number of paths is odd or zero, or the queries are not whole groups
        InputError : a direction is not a unit vector
        PartialError : samples stay non-finite after several draws; says which query and which effect
        """
        check_unit(queries.omega_i, "omega_i")
        check_unit(queries.omega_o, "omega_o")
        counts = np.full(len(queries.sigma), spp, np.int64) if isinstance(spp, int) else spp
        if counts.min() < 2 or (counts % 2).any():
            raise ValueError(f"spp must be even, for two equal halves, not {spp}")
        shared = counts[: len(counts) // lights]
        if not np.array_equal(np.tile(shared, lights), counts):
            raise ValueError(f"queries must be groups of {lights} with equal numbers of paths")
        groups = np.arange(len(counts)).reshape(lights, -1)
        most = dr.opaque(mi.UInt32, self.transport.limit if limit is None else limit)
        late = dr.opaque(mi.UInt32, self.transport.roulette_depth if roulette is None else roulette)
        parts = [
            _Launch(
                self,
                queries.take(groups[:, rows].ravel()),
                rows.start,
                shared[rows],
                stream,
                source or self._sensor,
                most,
                late,
                lights,
            ).estimates(path_variance)
            for rows in self._launches(shared, lights)
        ]

        def joined(name: str) -> Any:
            arrays = [getattr(p, name) for p in parts]
            if arrays[0] is None:
                return None
            by_light = [a.reshape(lights, -1, *a.shape[1:]) for a in arrays]
            return np.concatenate(by_light, axis=1).reshape(len(counts), *arrays[0].shape[1:])

        return Estimates(
            joined("value_a"),
            joined("value_b"),
            joined("transmittance"),
            int(shared.sum()),
            sum(p.lost for p in parts),
            sum(p.capped for p in parts),
            sum(p.nonfinite for p in parts),
            tuple(b for p in parts for b in p.bad_samples)[:MOST_LOCATED],
            spp=None if isinstance(spp, int) else counts,
            path_variance=joined("path_variance"),
        )

    def _launches(self, counts: NDArray[np.int64], lights: int) -> Iterator[slice]:
        """Consecutive groups to trace in one launch: few enough that each ends soon; one group at least."""
        ends = np.cumsum(counts)
        start, traced = 0, 0
        while start < len(counts):
            size = max(1, min(self._size, self.launch) // lights)
            stop = max(start + 1, int(np.searchsorted(ends, traced + size, side="right")))
            began = time.perf_counter()
            yield slice(start, stop)
            seconds = time.perf_counter() - began
            paths = int(ends[stop - 1]) - traced
            if seconds > _LONG:
                self._size = max(FIRST_LAUNCH, lights * size // 2)
            elif seconds < _SHORT and paths > size // 2:
                self._size = 2 * lights * size
            start, traced = stop, int(ends[stop - 1])
            self.observe(paths)


class _Launch:
    """All paths of consecutive groups of queries, one lane per path, one group after the other.

    Radiance has a *slot* for each light of each path: those of the first lights of all paths, of the second
    ones, and so on.

    Parameters
    ----------
    queries : of the groups: those of all first lights, of all second ones, …
    first : number of the first of the groups in the shard
    counts : (n,) paths of each group
    limit, roulette : as of :class:`~mbtf_gen.render.path_tracer.PathTracer`
    lights : queries of a group
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
        lights: int,
    ) -> None:
        self.estimator, self.first, self.counts, self.stream = estimator, first, counts, stream
        self.source, self.limit, self.roulette = source, limit, roulette
        self.paths, self.group_size = int(counts.sum()), lights
        source.set_queries(queries.take(slice(len(counts))), first)
        self.lights = DirectionalLight.of(estimator.light, queries.omega_i)
        # First lane of each group, and the paths of one half of it.
        self.starts = np.cumsum(counts) - counts
        self.start, self.half = _aligned(self.starts), _aligned(counts // 2)
        # Group of each lane.
        self.group = _aligned(np.repeat(np.arange(len(counts), dtype=np.uint32), counts))
        # Lower half of the sorting key: 4 bits each of the cosines of ω_o and ω_i.
        view, light = (
            np.clip(16.0 * w[:, 2].reshape(lights, -1).mean(axis=0), 0, 15).astype(np.uint32)
            for w in (queries.omega_o, queries.omega_i)
        )
        self.direction_key = _aligned(view << 4 | light)

    def estimates(self, path_variance: bool) -> Estimates:
        """Estimates of the queries; paths with a sample that is not finite are traced again."""
        radiance, passed, lost, capped = self._trace()
        values = self._halves(radiance, self.group_size)
        # Few launches have non-finite samples: their lanes are searched only then.
        bad = np.zeros(0, np.uint32) if np.isfinite(values).all() else self._nonfinite(radiance, self.paths)
        located = self._located(bad[:MOST_LOCATED])
        nonfinite = len(bad)
        for attempt in range(1, MAX_RESAMPLES + 1):
            if not len(bad):
                break
            lanes = mi.UInt32(padded(bad))
            again, through, more_lost, more_capped = self._trace(lanes, attempt)
            slots = np.concatenate([bad + np.uint32(k * self.paths) for k in range(self.group_size)])
            dr.scatter(radiance, again, mi.UInt32(padded(slots)))
            if self.estimator.holes:
                dr.scatter(passed, through, lanes)
            dr.eval(radiance, passed)
            lost, capped = lost + more_lost, capped + more_capped
            bad = bad[self._nonfinite(again, len(bad))]
            nonfinite += len(bad)
        if len(bad):
            raise PartialError(
                f"{len(bad)} samples stay NaN or infinite after {MAX_RESAMPLES} draws, first at "
                f"query {self._number(bad[0])} ({located[0].effect})",
                where=f"{self.stream.split} shard {self.stream.shard}",
                hint="check the material's values",
            )
        if nonfinite:
            values = self._halves(radiance, self.group_size)
        through = self._halves(passed).mean(axis=(1, 2)).astype(np.float32) if self.estimator.holes else None
        return Estimates(
            values[:, 0].astype(np.float32),
            values[:, 1].astype(np.float32),
            None if through is None else np.tile(through, self.group_size),
            self.paths,
            lost,
            capped,
            nonfinite,
            located,
            path_variance=self._variances(radiance, values) if path_variance else None,
        )

    def _number(self, lane: int) -> int:
        """Number in the shard of the first query of a lane."""
        return self.first + int(np.searchsorted(self.starts, lane, side="right")) - 1

    def _halves(self, x: Float | Color3f, lights: int = 1) -> NDArray[np.float64]:
        """Mean of each half of each query, (n, 2, channels), of one number or color per slot; with one light,
        of each group and of one per lane."""
        groups = dr.opaque(mi.UInt32, len(self.counts))
        which = dr.arange(mi.UInt32, 2 * lights * len(self.counts))
        query, second = which >> 1, which & 1
        light = query // groups
        group = query - light * groups
        half = dr.gather(mi.UInt32, self.half, group)
        begin = dr.gather(mi.UInt32, self.start, group) + second * half
        begin += light * dr.opaque(mi.UInt32, self.paths)
        totals = [_sum_of(channel, begin, begin + half) for channel in (x if dr.depth_v(x) == 2 else [x])]
        dr.eval(totals)
        total = np.stack([np.array(t) for t in totals], axis=-1)
        halves = np.tile(self.counts // 2, lights)
        return total.reshape(len(halves), 2, -1) / halves[:, None, None]

    def _nonfinite(self, radiance: Color3f, width: int) -> NDArray[np.uint32]:
        """Numbers of the traced paths, `width` of them, with a color that is NaN or infinite."""
        return np.unique(_nonfinite(radiance) % np.uint32(width))

    def _variances(self, radiance: Color3f, values: NDArray[np.float64]) -> NDArray[np.float32]:
        """Sample variance of each query's paths, mean over channels."""
        square = self._halves(dr.squared_norm(radiance), self.group_size).mean(axis=(1, 2)) / 3.0
        spread = square - np.mean(values.mean(axis=1) ** 2, axis=-1)
        counts = np.tile(self.counts, self.group_size)
        return np.maximum(spread * counts / (counts - 1), 0.0).astype(np.float32)

    def _located(self, bad: NDArray[np.uint32]) -> tuple[BadSample, ...]:
        """Queries of non-finite lanes, and the effect at fault: direct light, if their paths are non-finite
        after one interaction."""
        if not len(bad):
            return ()
        first = self._trace(mi.UInt32(padded(bad)), limit=dr.opaque(mi.UInt32, 1))[0]
        direct = self._nonfinite(first, len(bad))
        return tuple(
            BadSample(self._number(lane), "direct light" if k in direct else "interreflection")
            for k, lane in enumerate(bad)
        )

    def _points(self, lane: UInt32, group: UInt32, purpose: Purpose, attempt: int) -> SobolSampler:
        """Random numbers of paths."""
        path = lane - dr.gather(mi.UInt32, self.start, group)
        half = dr.gather(mi.UInt32, self.half, group)
        second = path >= half
        # Both halves take the same points, of differently scrambled sequences.
        s, number = self.stream, self.stream.first_pass + attempt
        keys = [stream_key(s.root, stream_number(s.split, s.shard, purpose, number, h)) for h in (1, 0)]
        low, high = (
            dr.select(second, *(dr.opaque(mi.UInt32, key >> shift & 0xFFFFFFFF) for key in keys))
            for shift in (0, 32)
        )
        of_shard = group + dr.opaque(mi.UInt32, self.first)
        return sequence(low, high, of_shard, dr.select(second, path - half, path))

    def _trace(
        self, which: UInt32 | None = None, attempt: int = 0, limit: UInt32 | None = None
    ) -> tuple[Color3f, Float, int, int]:
        """Radiance of each slot of some of the lanes (all, if None); where rays can pass, 1 where the first
        ray of a lane was transmitted; counts of lost and capped rays."""
        everything = which is None
        if everything:
            which, group = dr.arange(mi.UInt32, self.paths), self.group
        else:
            group = dr.gather(mi.UInt32, self.group, which)
        xi = self._points(which, group, Purpose.FOOTPRINT, attempt).next_2d()
        point = self.source.footprint(group, xi)
        key = _position_key(point) | dr.gather(mi.UInt32, self.direction_key, group)
        dr.eval(point, key)
        order = _aligned(np.argsort(np.array(key).astype(np.uint16), kind="stable"))

        lane = order if everything else dr.gather(mi.UInt32, which, order)
        group = dr.gather(mi.UInt32, self.group, lane)
        tracer = self._tracer(group, order, self.limit if limit is None else limit)
        ray = self.source.ray(group, dr.gather(mi.Point2f, point, order))
        path = tracer.trace(ray, self._points(lane, group, Purpose.PATH, attempt))
        radiance = dr.zeros(mi.Color3f, dr.width(which))
        dr.scatter(radiance, path.radiance, order)
        if isinstance(tracer, GroupTracer):
            radiance = dr.tile(radiance, self.group_size) + tracer.radiance
        passed = None
        if self.estimator.holes:
            passed = dr.zeros(mi.Float, dr.width(which))
            dr.scatter(passed, dr.select(path.passed, 1.0, 0.0), order)
        dr.eval(radiance, passed, path.lost, path.capped)
        return radiance, passed, int(dr.count(path.lost)[0]), int(dr.sum(path.capped)[0])

    def _tracer(self, group: UInt32, slot: UInt32, limit: UInt32) -> PathTracer:
        """Tracer of lanes of given groups, whose first slots are `slot`."""
        tile, transport = self.estimator.tile, self.estimator.transport
        if self.group_size == 1:
            return PathTracer(tile, transport, self.lights.at(group), limit, self.roulette)
        groups = len(self.counts)
        return GroupTracer.of(
            tile, transport, self.lights, limit, self.roulette, group, groups, slot, self.group_size
        )


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
