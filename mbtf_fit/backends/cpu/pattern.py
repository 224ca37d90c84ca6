"""The list of operations that the compiled kernel knows as a whole.

The kernel is one fused loop over queries. It evaluates lists of this form, whatever model they are of::

    [trace, shade] [offset | displace] lookup [half vector, difference vector] [hints] [frame] [fibers]
    network transform [gate]

and factors of calibration behind it, which are multiplied to its values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from mbtf_fit import ops
from mbtf_fit.ops.constants import LEAST_VARIANCE

T = TypeVar("T", bound=ops.Operation)
# Inputs of the decoder for light and view, and how many coordinates of each these are.
_LIGHTS = {("omega_i[0:2]", "omega_o[0:2]"): 2, ("omega_i", "omega_o"): 3}

# What is read of a query about the surface.
_READ = {"level": "level", "omega_i": "omega_i", "omega_o": "omega_o"}

# Of a transform that the kernel computes from its function and its scale alone.
_SCALED = {"divisor": None, "factor": None, "most": None}


@dataclass(frozen=True)
class Pattern:
    """A list that the kernel can evaluate.

    Attributes
    ----------
    lookup, decoder : the features, and the network that decodes them
    offset, offset_network : the neural offset, or None
    displace : displacement by traced heights, or None
    coordinates : of light and of view that the decoder reads
    half_vector, hints, frame, fibers : whether it reads those
    irradiance_scale, depth_scale : factors of the irradiance under the logarithm, and of the height that is
        read with the fibers
    unit, most : tensors of the unit and of the bound
    gate : whether the value has a gated core
    factors : names of calibration factors that the value is multiplied by
    """

    lookup: ops.Lookup
    decoder: ops.Network
    offset: ops.Offset | None
    offset_network: ops.Network | None
    displace: ops.Displace | None
    coordinates: int
    half_vector: bool
    hints: bool
    frame: bool
    fibers: bool
    irradiance_scale: float
    depth_scale: float
    unit: str
    most: str
    gate: bool
    factors: tuple[str, ...]


class _Unknown(Exception):
    """The list has another form."""


def match(operations: Sequence[ops.Operation]) -> Pattern | None:
    """The list as the kernel sees it; None if it has another form."""
    try:
        return _Matcher(operations).pattern()
    except _Unknown:
        return None


class _Matcher:
    def __init__(self, operations: Sequence[ops.Operation]) -> None:
        self._by_output = {op.output: op for op in operations}
        self._last = operations[-1]
        self._unused = {*self._by_output}

    def _take(self, name: str, kind: type[T], **fields: Any) -> T:
        """The operation that computes a value, which must be of a kind and have these fields."""
        found = self._by_output.get(name)
        if not isinstance(found, kind):
            raise _Unknown
        self._expect(*(getattr(found, key) == value for key, value in fields.items()))
        self._unused.discard(name)
        return found

    def _is(self, name: str, kind: type[ops.Operation]) -> bool:
        return isinstance(self._by_output.get(name), kind)

    def _expect(self, *conditions: bool) -> None:
        if not all(conditions):
            raise _Unknown

    def pattern(self) -> Pattern:
        value, *factors = [self._last.output]
        if isinstance(self._last, ops.Product):
            value, *factors = self._take(value, ops.Product).x
        for name in factors:
            self._take(name, ops.Calibrate)
        gate = self._take(value, ops.Gate, floor=0.0, scale=2.0) if self._is(value, ops.Gate) else None
        own = value if gate is None else gate.plus or ""
        color = self._take(own, ops.Transform, function="expm1", scale=1.0, divisor=None)
        unit, most = color.factor or "", color.most or ""
        name, _, part = color.x.partition("[")
        self._expect(part in ("", "0:3]"), "" not in (unit, most))
        decoder = self._take(name, ops.Network, outputs=3 + (gate is not None), activation="relu")
        features, light, view, *rest = (*decoder.x, "", "", "")[: max(3, len(decoder.x))]
        lookup = self._take(features, ops.Lookup, level="level", finer=0.0)
        self._expect((light, view) in _LIGHTS)
        half = bool(rest) and self._is(rest[0], ops.HalfVector)
        if half:
            axis = self._take(rest.pop(0), ops.HalfVector).output
            self._take(rest.pop(0) if rest else "", ops.Rotate, axis=axis, omega="omega_i")
        displace, offset, network = self._moved(lookup.u)
        fibers = bool(rest) and self._is(rest[-1], ops.FiberFrame)
        about = rest.pop() if fibers else ""
        depth = rest.pop() if fibers and rest else ""
        hints, scale, frame, depth_scale = False, 1.0, len(rest) in (2, 5), 0.0
        if displace is not None:
            shade, hits = self._surface(displace)
            if fibers:
                self._take(about, ops.FiberFrame, hits=hits, **_READ)
                known = {"x": displace.z, "function": "identity", **_SCALED}
                depth_scale = self._take(depth, ops.Transform, **known).scale
            if len(rest) >= 3:
                hints, scale = True, self._hints(rest, shade, unit)
                del rest[:3]
            if frame:
                for omega in ("omega_i", "omega_o"):
                    self._take(rest.pop(0), ops.Rotate, axis=f"{shade}[1:3]", omega=omega)
            self._expect(gate is None or gate.x == f"{shade}[3:6]")
        if gate is not None:
            self._expect(gate.unit == unit, gate.gate == f"{name}[3:4]")
        # An operation that nothing above reads changes nothing, but its form is not known.
        self._expect(not rest, not self._unused)
        return Pattern(
            *(lookup, decoder, offset, network, displace, _LIGHTS[light, view], half, hints, frame, fibers),
            *(scale, depth_scale, unit, most, gate is not None, tuple(factors)),
        )

    def _moved(self, name: str) -> tuple[ops.Displace | None, ops.Offset | None, ops.Network | None]:
        """How the position that the features are read at is computed."""
        if name == "u":
            return None, None, None
        if self._is(name, ops.Displace):
            return self._take(name, ops.Displace, u="u", level="level", omega_o="omega_o"), None, None
        offset = self._take(name, ops.Offset, u="u", omega_o="omega_o")
        network = self._take(offset.r, ops.Network, outputs=1, activation="relu")
        self._expect(network.x[1:] == ("omega_o[0:2]",))
        self._take(network.x[0], ops.Lookup, u="u", level=None)
        return None, offset, network

    def _surface(self, displace: ops.Displace) -> tuple[str, str]:
        """Names of the shading of the surface that the displacement is traced to, and of intersections."""
        trace = self._take(displace.z, ops.Trace, u="u", level="level", omega_o="omega_o")
        shades = [name for name in self._by_output if self._is(name, ops.Shade)]
        self._expect(len(shades) == 1)
        shade = self._take(shades[0], ops.Shade, hits=trace.hits, least_variance=LEAST_VARIANCE, **_READ)
        shadows = (shade.depths, shade.heights)
        self._expect(shadows in ((None, None), (trace.depths, trace.heights)))
        return shades[0], trace.hits

    def _hints(self, rest: Sequence[str], shade: str, unit: str) -> float:
        """Factor of the irradiance under the logarithm."""
        known = {"function": "log1p", **_SCALED}
        self._take(rest[2], ops.Transform, x=f"{shade}[3:6]", scale=1.0, **{**known, "divisor": unit})
        self._expect(rest[1] == f"{shade}[1:3]")
        return self._take(rest[0], ops.Transform, x=f"{shade}[0:1]", **known).scale
