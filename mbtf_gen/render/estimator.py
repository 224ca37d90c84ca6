"""Monte Carlo estimates of M at queries: two independent halves per query.

The paths of a launch are sorted by position on the reference plane and by the elevations of view and light,
so that neighboring lanes take about as many traversal steps. The random numbers of a path depend only on its
number in the shard, so values do not depend on how queries are grouped into launches.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import PartialError
from mbtf_gen.render.directional_light import DirectionalLight
from mbtf_gen.render.estimates import MOST_LOCATED, BadSample, Estimates, Stream
from mbtf_gen.render.path_tracer import TraceOptions, Transport, trace
from mbtf_gen.render.scene import CLEARANCE, Tile
from mbtf_gen.render.types import Color3f, Float, Float64, Point2f, Ray3f, UInt32, Vector3f
from mbtf_gen.sampling.light_kernel import LightKernel
from mbtf_gen.sampling.query_sampler import Queries
from mbtf_gen.sampling.rng import Purpose, sequence, stream_key, stream_number
from mbtf_gen.sampling.sobol import SobolSampler

# Paths per launch: enough to fill any machine, few enough to fit into memory.
LAUNCH_PATHS = 1 << 20
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


def _position_key(point: Point2f) -> UInt32:
    """Upper half of a path's sorting key: 8 bits of a Morton curve over the tile."""
    cell = mi.Vector2u((point - dr.floor(point)) * 16.0)

    def spread(x: UInt32) -> UInt32:
        x = (x | (x << 2)) & 0x33
        return (x | (x << 1)) & 0x55

    return (spread(cell.x) | (spread(cell.y) << 1)) << 8


def _direction_key(queries: Queries) -> UInt32:
    """Lower half of the sorting key: 4 bits each of the cosines of ω_o and ω_i."""
    view, light = (
        np.clip(16.0 * omega[:, 2], 0, 15).astype(np.uint32) for omega in (queries.omega_o, queries.omega_i)
    )
    return _aligned(view << 4 | light)


def _aligned(numbers: NDArray[Any]) -> UInt32:
    """Lane numbers as a copy: NumPy's memory is aligned or not by chance, and kernels would be compiled for
    either case."""
    copied = mi.UInt32(numbers.astype(np.uint32)) + dr.opaque(mi.UInt32, 0)
    dr.eval(copied)
    return copied


def _launches(counts: NDArray[np.int64], launch: int) -> list[slice]:
    """Consecutive queries that together have at most `launch` paths, or one query that has more."""
    ends = np.cumsum(counts)
    out, start, traced = [], 0, 0
    while start < len(counts):
        stop = max(start + 1, int(np.searchsorted(ends, traced + launch, side="right")))
        out.append(slice(start, stop))
        start, traced = stop, int(ends[stop - 1])
    return out


@dataclass(frozen=True)
class Lanes:
    """The lanes of a launch: all paths of its queries, one query after the other.

    Attributes
    ----------
    first : number of the first query in the shard
    counts : (n,) paths of each query; starts : (n,) its first lane
    query : query of each lane
    start, half : first lane of each query, and the paths of one half
    direction_key : lower half of the sorting key of each query
    """

    first: int
    counts: NDArray[np.int64]
    starts: NDArray[np.int64]
    query: UInt32
    start: UInt32
    half: UInt32
    direction_key: UInt32

    @classmethod
    def of(cls, first: int, counts: NDArray[np.int64], queries: Queries) -> Lanes:
        """Lanes of consecutive queries."""
        starts = np.cumsum(counts) - counts
        query = np.repeat(np.arange(len(counts), dtype=np.uint32), counts)
        columns = [*(_aligned(x) for x in (query, starts, counts // 2)), _direction_key(queries)]
        return cls(first, counts, starts, *columns)

    def number(self, lane: int) -> int:
        """Number of a lane's query in the shard."""
        return self.first + int(np.searchsorted(self.starts, lane, side="right")) - 1

    def halves(self, x: Float | Color3f) -> NDArray[np.float64]:
        """Mean of each half of each query, (n, 2, channels), of one number or color per lane."""
        which = dr.arange(mi.UInt32, 2 * len(self.counts))
        query, second = which >> 1, which & 1
        half = dr.gather(mi.UInt32, self.half, query)
        begin = dr.gather(mi.UInt32, self.start, query) + second * half
        totals = [_sum_of(channel, begin, begin + half) for channel in (x if dr.depth_v(x) == 2 else [x])]
        dr.eval(totals)
        total = np.stack([np.array(t) for t in totals], axis=-1)
        return total.reshape(len(self.counts), 2, -1) / (self.counts // 2)[:, None, None]


@dr.syntax
def _sum_of(x: Float, lane: UInt32, end: UInt32) -> Float64:
    """Sums over ranges of lanes, in order, so that they do not depend on threads or launches."""
    total, lane = mi.Float64(0.0), mi.UInt32(lane)
    while dr.hint(lane < end, exclude=[x, end]):
        total += mi.Float64(dr.gather(mi.Float, x, lane))
        lane += 1
    return total


class Estimator:
    """Monte Carlo estimator of M on one tile.

    Parameters
    ----------
    tile : Tile
        The displaced tile, see :func:`~mbtf_gen.render.scene.build_tile`.
    light : LightKernel or None
        Smoothed directional light; None for constant radiance 1 from the upper hemisphere (white furnace).
    transport : Transport
        Effects that are simulated.
    launch : int
        Paths per kernel launch; does not change the values.

    Attributes
    ----------
    holes : bool
        Whether the surface has an opacity mask, so that the transmittance is estimated.
    """

    def __init__(
        self, tile: Tile, light: LightKernel | None, transport: Transport, launch: int = LAUNCH_PATHS
    ) -> None:
        self.tile = tile
        self.light = light
        self.transport = transport
        self.launch = launch
        self.holes = bool(tile.world.surface.parts.opacity)
        self._sensor = mi.load_dict(
            {"type": "mbtf_queries", "unit": tile.unit, "aspect": tile.aspect, "start": CLEARANCE}
        )
        self._kappa = dr.opaque(mi.Float, 0.0 if light is None or light.is_delta else light.kappa)

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
        spp : int or (n,) int64 array
            Paths per query, both halves together; even.
        stream : Stream
            Random numbers to use.
        source : RaySource, optional
            Source of the first rays; the query sensor by default.
        limit : int, optional
            Largest number of surface interactions of a path; that of the transport by default.
        roulette : int, optional
            Interactions before Russian roulette starts; that of the transport by default.
        path_variance : bool
            Also estimate the sample variance of single paths.

        Returns
        -------
        Estimates
            Values of both halves in 1/sr, with counts of lost and non-finite samples.

        Raises
        ------
        ValueError
            A number of paths is odd or zero.
        PartialError
            Samples stay non-finite after several draws; says which query and which effect.
        """
        n = len(queries.sigma)
        counts = np.full(n, spp, np.int64) if isinstance(spp, int) else spp
        if n and (counts.min() < 2 or (counts % 2).any()):
            raise ValueError(f"spp must be even, for two equal halves, not {spp}")
        options = TraceOptions(
            dr.opaque(mi.UInt32, self.transport.limit if limit is None else limit),
            dr.opaque(mi.UInt32, self.transport.roulette_depth if roulette is None else roulette),
            path_variance,
        )
        parts = [
            self._batch(queries, rows, counts[rows], stream, source or self._sensor, options)
            for rows in _launches(counts, self.launch)
        ]
        return Estimates(
            np.concatenate([p.value_a for p in parts]),
            np.concatenate([p.value_b for p in parts]),
            np.concatenate([p.transmittance for p in parts]) if self.holes else None,
            int(counts.sum()),
            sum(p.lost for p in parts),
            sum(p.capped for p in parts),
            sum(p.nonfinite for p in parts),
            tuple(b for p in parts for b in p.bad_samples)[:MOST_LOCATED],
            spp=None if isinstance(spp, int) else counts,
            path_variance=np.concatenate([p.path_variance for p in parts]) if path_variance else None,
        )

    def _batch(
        self,
        queries: Queries,
        rows: slice,
        counts: NDArray[np.int64],
        stream: Stream,
        source: RaySource,
        options: TraceOptions,
    ) -> Estimates:
        part = queries.take(rows)
        source.set_queries(part, rows.start)
        omega_i = mi.Vector3f(part.omega_i.T.copy())
        if self.light is None:
            inverse = mi.Float(0.0)
        else:
            inverse = mi.Float((1.0 / self.light.irradiance(part.omega_i)).astype(np.float32))
        # Evaluated before any kernel reads them: otherwise the number of queries would be part of the kernel.
        dr.eval(omega_i, inverse)
        lanes = Lanes.of(rows.start, counts, part)

        def trace_lanes(which: UInt32 | None, attempt: int) -> tuple[Color3f, Float, int, int]:
            return self._trace(source, lanes, which, stream, omega_i, inverse, attempt, options)

        radiance, passed, lost, capped = trace_lanes(None, 0)
        values = lanes.halves(radiance)
        # Few launches have non-finite samples: their lanes are searched only then.
        bad = np.zeros(0, np.uint32) if np.isfinite(values).all() else self._nonfinite(radiance)
        nonfinite = len(bad)
        located = self._located(source, lanes, bad[:MOST_LOCATED], stream, omega_i, inverse, options)
        for attempt in range(1, MAX_RESAMPLES + 1):
            if not len(bad):
                break
            again, through, more_lost, more_capped = trace_lanes(mi.UInt32(bad), attempt)
            dr.scatter(radiance, again, mi.UInt32(bad))
            dr.eval(radiance)
            if self.holes:
                dr.scatter(passed, through, mi.UInt32(bad))
                dr.eval(passed)
            lost, capped = lost + more_lost, capped + more_capped
            bad = bad[self._nonfinite(again)]
            nonfinite += len(bad)
        if len(bad):
            raise PartialError(
                f"{len(bad)} samples stay NaN or infinite after {MAX_RESAMPLES} draws, first at "
                f"query {lanes.number(int(bad[0]))} ({located[0].effect})",
                where=f"{stream.split} shard {stream.shard}",
                hint="check the material's values",
            )
        if nonfinite:
            values = lanes.halves(radiance)
        return Estimates(
            values[:, 0].astype(np.float32),
            values[:, 1].astype(np.float32),
            lanes.halves(passed).mean(axis=(1, 2)).astype(np.float32) if self.holes else None,
            int(counts.sum()),
            lost,
            capped,
            nonfinite,
            located,
            path_variance=self._variances(lanes, radiance, values) if options.path_variance else None,
        )

    def _located(
        self,
        source: RaySource,
        lanes: Lanes,
        bad: NDArray[np.uint32],
        stream: Stream,
        omega_i: Vector3f,
        inverse: Float,
        options: TraceOptions,
    ) -> tuple[BadSample, ...]:
        """Queries of non-finite lanes, and the effect at fault: direct light, if their paths are non-finite
        after one interaction."""
        if not len(bad):
            return ()
        short = replace(options, limit=dr.opaque(mi.UInt32, 1))
        radiance = self._trace(source, lanes, mi.UInt32(bad), stream, omega_i, inverse, 0, short)[0]
        direct = np.isin(np.arange(len(bad)), self._nonfinite(radiance))
        return tuple(
            BadSample(lanes.number(int(lane)), "direct light" if at_once else "interreflection")
            for lane, at_once in zip(bad, direct, strict=True)
        )

    def _variances(self, lanes: Lanes, radiance: Color3f, values: NDArray[np.float64]) -> NDArray[np.float32]:
        """Sample variance of each query's paths, mean over channels."""
        square = lanes.halves(dr.squared_norm(radiance)).mean(axis=(1, 2)) / 3.0
        spread = square - np.mean(values.mean(axis=1) ** 2, axis=-1)
        return np.maximum(spread * lanes.counts / (lanes.counts - 1), 0.0).astype(np.float32)

    def _nonfinite(self, radiance: Color3f) -> NDArray[np.uint32]:
        finite = dr.isfinite(radiance.x) & dr.isfinite(radiance.y) & dr.isfinite(radiance.z)
        if dr.all(finite)[0]:
            return np.zeros(0, np.uint32)
        return np.nonzero(~np.array(finite))[0].astype(np.uint32)

    def _trace(
        self,
        source: RaySource,
        lanes: Lanes,
        which: UInt32 | None,
        stream: Stream,
        omega_i: Vector3f,
        inverse: Float,
        attempt: int,
        options: TraceOptions,
    ) -> tuple[Color3f, Float, int, int]:
        """Radiance of some of the lanes (all, if None); with an opacity mask, 1 where the first ray was
        transmitted; counts of lost and capped rays."""

        def generator(lane: UInt32, query: UInt32, purpose: Purpose) -> SobolSampler:
            path = lane - dr.gather(mi.UInt32, lanes.start, query)
            half = dr.gather(mi.UInt32, lanes.half, query)
            second = path >= half
            # Both halves take the same points, of differently scrambled sequences.
            a, b = (
                stream_key(
                    stream.root,
                    stream_number(stream.split, stream.shard, purpose, stream.first_pass + attempt, h),
                )
                for h in (0, 1)
            )
            words = [
                dr.select(
                    second,
                    dr.opaque(mi.UInt32, b >> shift & 0xFFFFFFFF),
                    dr.opaque(mi.UInt32, a >> shift & 0xFFFFFFFF),
                )
                for shift in (0, 32)
            ]
            number = query + dr.opaque(mi.UInt32, lanes.first)
            return sequence(words[0], words[1], number, dr.select(second, path - half, path))

        everything = which is None
        if everything:
            which, query = dr.arange(mi.UInt32, int(lanes.counts.sum())), lanes.query
        else:
            query = dr.gather(mi.UInt32, lanes.query, which)
        point = source.footprint(query, generator(which, query, Purpose.FOOTPRINT).next_2d())
        key = _position_key(point) | dr.gather(mi.UInt32, lanes.direction_key, query)
        dr.eval(point, key)
        order = _aligned(np.argsort(np.array(key).astype(np.uint16), kind="stable"))

        lane = order if everything else dr.gather(mi.UInt32, which, order)
        query = dr.gather(mi.UInt32, lanes.query, lane)
        ray = source.ray(query, dr.gather(mi.Point2f, point, order))
        if self.light is None:
            light = DirectionalLight("constant")
        else:
            light = DirectionalLight(
                "delta" if self.light.is_delta else "lobe",
                dr.gather(mi.Vector3f, omega_i, query),
                dr.gather(mi.Float, inverse, query),
                self._kappa,
            )
        path = trace(
            self.tile.world,
            ray,
            light,
            self.transport,
            options,
            generator(lane, query, Purpose.PATH),
            mi.Bool(True),
        )
        radiance = dr.zeros(mi.Color3f, dr.width(which))
        dr.scatter(radiance, path.radiance, order)
        passed = None
        if self.holes:
            passed = dr.zeros(mi.Float, dr.width(which))
            dr.scatter(passed, dr.select(path.passed, 1.0, 0.0), order)
        dr.eval(radiance, passed, path.lost, path.capped)
        return radiance, passed, int(dr.count(path.lost)[0]), int(dr.sum(path.capped)[0])
