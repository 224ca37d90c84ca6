"""Monte Carlo estimates of M at queries: two independent halves per query.

Paths of one launch are traced in the order of the place where they meet the reference plane (a 16-bit Morton
key), which doubles the speed of incoherent queries. The random numbers of a path depend on its number in the
shard alone, so values do not depend on how queries are grouped into launches.
"""

from __future__ import annotations

from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .errors import PartialError
from .estimates import MOST_LOCATED, BadSample, Estimates, Stream
from .light import LightKernel
from .queries import Queries
from .scene import CLEARANCE, Tile
from .seeds import Purpose, sequence, stream_key, stream_number
from .tracing import LaneLight, Transport, trace

# Paths per launch: enough to fill any machine, few enough to stay small in memory.
LAUNCH_PATHS = 1 << 20
# Passes in which a path that came out non-finite is traced again before the run is stopped.
MAX_RESAMPLES = 4


class RaySource(Protocol):
    """What rays of queries start from: the query sensor, or a camera's pixels."""

    def set_queries(self, queries: Queries, first: int = 0) -> None:
        """Take a batch of queries; `first` is the number of its first query."""

    def footprint(self, query: Any, xi: Any) -> Any:
        """uv of a point of the footprint of queries of the batch, not wrapped."""

    def ray(self, query: Any, point: Any) -> Any:
        """Ray through such a point, in scene units."""


def _spread_bits(x: Any) -> Any:
    x = (x | (x << 4)) & 0x0F0F
    x = (x | (x << 2)) & 0x3333
    return (x | (x << 1)) & 0x5555


def _aligned(numbers: NDArray[Any]) -> Any:
    """Lane numbers as a copy: memory borrowed from NumPy is aligned by chance, and kernels that read it are
    compiled for either case."""
    copied = mi.UInt32(numbers.astype(np.uint32)) + dr.opaque(mi.UInt32, 0)
    dr.eval(copied)
    return copied


class Estimator:
    """Traces queries against one tile.

    Parameters
    ----------
    tile : the displaced tile
    light : smoothed directional light, or None for constant radiance 1 from above (furnace)
    transport : how paths are followed
    launch : paths per launch
    """

    def __init__(
        self, tile: Tile, light: LightKernel | None, transport: Transport, launch: int = LAUNCH_PATHS
    ) -> None:
        self.tile = tile
        self.light = light
        self.transport = transport
        self.launch = launch
        # Whether rays may pass through, so that what passed is counted.
        self.holes = bool(tile.world.surface.parts.opacity)
        self._sensor = mi.load_dict(
            {"type": "mbtf_queries", "unit": tile.unit, "aspect": tile.aspect, "start": CLEARANCE}
        )
        self._kappa = dr.opaque(mi.Float, 0.0 if light is None or light.is_delta else light.kappa)

    def estimate(
        self,
        queries: Queries,
        spp: int,
        stream: Stream,
        source: RaySource | None = None,
        limit: int | None = None,
        roulette: int | None = None,
    ) -> Estimates:
        """Both halves of each query (one leading axis), `spp` paths together.

        Parameters
        ----------
        source : where rays come from; the query sensor by default
        limit, roulette : other numbers of surface interactions at which paths end, and at which roulette
            begins, for the same kernel

        Raises
        ------
        PartialError : samples stay non-finite after several draws; says where
        """
        if spp < 2 or spp % 2:
            raise ValueError(f"spp must be even, for two equal halves, not {spp}")
        self._limit = dr.opaque(mi.UInt32, self.transport.limit if limit is None else limit)
        self._roulette = dr.opaque(mi.UInt32, self.transport.roulette_depth if roulette is None else roulette)
        n = len(queries.sigma)
        per_launch = max(1, self.launch // spp)
        parts = [
            self._batch(
                queries, slice(start, min(start + per_launch, n)), spp, stream, source or self._sensor
            )
            for start in range(0, n, per_launch)
        ]
        return Estimates(
            np.concatenate([p.value_a for p in parts]),
            np.concatenate([p.value_b for p in parts]),
            np.concatenate([p.transmittance for p in parts]) if self.holes else None,
            n * spp,
            sum(p.lost for p in parts),
            sum(p.capped for p in parts),
            sum(p.nonfinite for p in parts),
            tuple(b for p in parts for b in p.bad_samples)[:MOST_LOCATED],
        )

    def _batch(self, queries: Queries, rows: slice, spp: int, stream: Stream, source: RaySource) -> Estimates:
        part = Queries(queries.u[rows], queries.sigma[rows], queries.omega_i[rows], queries.omega_o[rows])
        source.set_queries(part, rows.start)
        count = len(part.sigma)
        omega_i = mi.Vector3f(part.omega_i.T.copy())
        if self.light is None:
            inverse = mi.Float(0.0)
        else:
            inverse = mi.Float((1.0 / self.light.irradiance(part.omega_i)).astype(np.float32))
        # Before any kernel reads them: their places in NumPy's array, and so the number of queries, would be
        # a part of it.
        dr.eval(omega_i, inverse)
        lanes = dr.arange(mi.UInt32, count * spp)

        def trace_lanes(which: Any, attempt: int) -> tuple[Any, Any, int, int]:
            return self._trace(source, which, rows.start, spp, stream, omega_i, inverse, attempt)

        radiance, passed, lost, capped = trace_lanes(lanes, 0)
        bad = self._nonfinite(radiance)
        nonfinite = 0
        located = self._located(source, bad[:MOST_LOCATED], rows.start, spp, stream, omega_i, inverse)
        for attempt in range(1, MAX_RESAMPLES + 1):
            if not len(bad):
                break
            nonfinite += len(bad)
            again, through, more_lost, more_capped = trace_lanes(mi.UInt32(bad), attempt)
            dr.scatter(radiance, again, mi.UInt32(bad))
            dr.eval(radiance)
            if self.holes:
                dr.scatter(passed, through, mi.UInt32(bad))
                dr.eval(passed)
            lost, capped = lost + more_lost, capped + more_capped
            bad = bad[self._nonfinite(again)]
        if len(bad):
            raise PartialError(
                f"{len(bad)} samples stay NaN or infinite after {MAX_RESAMPLES} draws, first at "
                f"query {rows.start + int(bad[0]) // spp} ({located[0].effect})",
                where=f"{stream.split} shard {stream.shard}",
                cure="check the material's values",
            )
        half = spp // 2
        mean = dr.block_reduce(dr.ReduceOp.Add, radiance, half, mode="evaluated") * (1.0 / half)
        values = np.array(mean, np.float32).T.reshape(count, 2, 3)
        return Estimates(
            np.ascontiguousarray(values[:, 0]),
            np.ascontiguousarray(values[:, 1]),
            self._shares(passed, spp) if self.holes else None,
            count * spp,
            lost,
            capped,
            nonfinite,
            located,
        )

    def _located(
        self,
        source: RaySource,
        bad: NDArray[np.uint32],
        first: int,
        spp: int,
        stream: Stream,
        omega_i: Any,
        inverse: Any,
    ) -> tuple[BadSample, ...]:
        """Queries of bad lanes, and the effect at fault: their paths cut after one interaction show whether
        direct light is."""
        if not len(bad):
            return ()
        full, self._limit = self._limit, dr.opaque(mi.UInt32, 1)
        short = self._trace(source, mi.UInt32(bad), first, spp, stream, omega_i, inverse, 0)[0]
        self._limit = full
        direct = np.isin(np.arange(len(bad)), self._nonfinite(short))
        return tuple(
            BadSample(first + int(lane) // spp, "direct light" if at_once else "interreflection")
            for lane, at_once in zip(bad, direct, strict=True)
        )

    def _shares(self, passed: Any, spp: int) -> NDArray[np.float32]:
        total = dr.block_reduce(dr.ReduceOp.Add, passed, spp, mode="evaluated")
        return np.array(total * (1.0 / spp), np.float32)

    def _nonfinite(self, radiance: Any) -> NDArray[np.uint32]:
        finite = dr.isfinite(radiance.x) & dr.isfinite(radiance.y) & dr.isfinite(radiance.z)
        if dr.all(finite)[0]:
            return np.zeros(0, np.uint32)
        return np.nonzero(~np.array(finite))[0].astype(np.uint32)

    def _trace(
        self,
        source: RaySource,
        lanes: Any,
        first: int,
        spp: int,
        stream: Stream,
        omega_i: Any,
        inverse: Any,
        attempt: int,
    ) -> tuple[Any, Any, int, int]:
        """Radiance of the given lanes (query · spp + path) and, where there are holes, whether they passed
        through the tile, in their order; counts of lost and capped rays."""
        half = spp // 2

        def generator(lane: Any, purpose: Purpose) -> Any:
            # Both halves take the same points of sequences of other streams.
            a, b = (
                stream_key(stream.root, stream_number(stream.split, stream.shard, purpose, attempt, h))
                for h in (0, 1)
            )
            words = [
                dr.select(
                    (lane // half) % 2 == 0,
                    dr.opaque(mi.UInt32, a >> shift & 0xFFFFFFFF),
                    dr.opaque(mi.UInt32, b >> shift & 0xFFFFFFFF),
                )
                for shift in (0, 32)
            ]
            return sequence(words[0], words[1], lane // spp + dr.opaque(mi.UInt32, first), lane % half)

        xi = generator(lanes, Purpose.FOOTPRINT).next_2d()
        point = source.footprint(lanes // spp, xi)
        cell = mi.Vector2u((point - dr.floor(point)) * 256.0)
        key = _spread_bits(cell.x) | (_spread_bits(cell.y) << 1)
        dr.eval(point, key)
        order = _aligned(np.argsort(np.array(key).astype(np.uint16), kind="stable"))

        lane = dr.gather(mi.UInt32, lanes, order)
        query = lane // spp
        ray = source.ray(query, dr.gather(mi.Point2f, point, order))
        if self.light is None:
            light = LaneLight("constant")
        else:
            light = LaneLight(
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
            self._limit,
            self._roulette,
            generator(lane, Purpose.PATH),
            mi.Bool(True),
        )
        radiance = dr.zeros(mi.Color3f, dr.width(lanes))
        dr.scatter(radiance, path.radiance, order)
        passed = None
        if self.holes:
            passed = dr.zeros(mi.Float, dr.width(lanes))
            dr.scatter(passed, dr.select(path.passed, 1.0, 0.0), order)
        dr.eval(radiance, passed, path.lost, path.capped)
        return radiance, passed, int(dr.count(path.lost)[0]), int(dr.sum(path.capped)[0])
