"""Path tracing with several lights per path: one path serves a group of queries of the same view.

Every vertex of a path is connected to the lights of all queries of its group, one shadow ray each, and the
ray to the next vertex is shared. The values of a group are therefore correlated; each has the distribution
that it has with paths of its own. No decision about a path depends on a light: Russian roulette follows the
throughput alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mbtf_gen.engine.types import Color3f, Mask, Spectrum, SurfaceInteraction3f, UInt32
from mbtf_gen.render.directional_light import DirectionalLight
from mbtf_gen.render.path_tracer import Path, PathTracer, ScatteredRay, Shadow, Transport
from mbtf_gen.render.scene import TileScene


@dataclass(frozen=True)
class GroupTracer(PathTracer):
    """Traces paths of which each has several lights.

    Attributes
    ----------
    light : the first lights of all groups, then the second ones, and so on
    group, groups : group of each lane; number of groups
    count : lights of each lane; opaque and of width 1, so that all group sizes share the compiled kernel
    radiance : what the paths gather from each light: that of a lane's k-th light is at ``slot + k stride``
    slot, stride : of each lane; of all lanes
    """

    group: UInt32
    groups: UInt32
    count: UInt32
    radiance: Color3f
    slot: UInt32
    stride: UInt32

    @classmethod
    def of(
        cls,
        tile: TileScene,
        transport: Transport,
        lights: DirectionalLight,
        limit: UInt32,
        roulette: UInt32,
        group: UInt32,
        groups: int,
        slot: UInt32,
        count: int,
    ) -> GroupTracer:
        """Tracer of lanes of given groups of `count` lights, without radiance yet."""
        lanes = dr.width(slot)
        radiance = dr.zeros(mi.Color3f, count * lanes)
        dr.make_opaque(radiance)
        among, size, stride = (dr.opaque(mi.UInt32, n) for n in (groups, count, lanes))
        return cls(tile, transport, lights, limit, roulette, group, among, size, radiance, slot, stride)

    @property
    def _of_lanes(self) -> Any:
        return self.group, self.slot

    def _compacted(self, lanes: UInt32) -> GroupTracer:
        group, slot = (dr.gather(mi.UInt32, x, lanes) for x in (self.group, self.slot))
        return replace(self, group=group, slot=slot)

    def _with_light(self, k: UInt32) -> PathTracer:
        """The tracer of each lane's k-th light alone."""
        light = self.light.at(self.group + k * self.groups)
        return PathTracer(self.tile, self.transport, light, self.limit, self.roulette)

    def _add(self, radiance: Spectrum, k: UInt32, active: Mask) -> None:
        """Add to the radiance from each lane's k-th light."""
        # Other modes lose NaN, which is searched for later.
        at, mode = self.slot + k * self.stride, dr.ReduceMode.Direct
        dr.scatter_reduce(dr.ReduceOp.Add, self.radiance, mi.Color3f(radiance), at, active, mode)

    @dr.syntax
    def _direct(self, path: Path, si: SurfaceInteraction3f, point: Any) -> Shadow | None:
        if dr.hint(self.light.kind == "constant", mode="scalar"):
            return None
        k, common = mi.UInt32(0), mi.Spectrum(path.radiance)
        lit = mi.Mask(path.active)
        while dr.hint(lit & (k < self.count), exclude=[self, si, point, common, lit]):
            path.radiance = mi.Spectrum(0.0)
            one = self._with_light(k)
            shadow = one._direct(path, si, point)
            if shadow is not None:
                one._trace_shadow(path, shadow)
            self._add(path.radiance, k, lit)
            k += 1
        path.radiance = common
        return None

    @dr.syntax
    def _escaped(self, path: Path, scattered: ScatteredRay, escaped: Mask) -> Spectrum:
        k = mi.UInt32(0)
        while dr.hint(escaped & (k < self.count), exclude=[self, path, scattered, escaped]):
            self._add(self._with_light(k)._escaped(path, scattered, escaped), k, escaped)
            k += 1
        return mi.Spectrum(0.0)
