"""The list of operations that the compiled kernel knows as a whole.

The kernel is one fused loop over queries. It evaluates lists of this form, whatever model they are of::

    [trace, shade] [offset | displace] lookup [half vector, difference vector] [hints] [frame]
    network transform [gate]

and factors of calibration behind it, which are multiplied to its values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

from mbtf_fit import ops
from mbtf_fit.ops.constants import LEAST_VARIANCE

T = TypeVar("T", bound=ops.Operation)
# Inputs of the decoder for light and view, and how many coordinates of each these are.
_LIGHTS = {
    ("omega_i[0:2]", "omega_o[0:2]"): 2,
    ("omega_i", "omega_o"): 3,
}


@dataclass(frozen=True)
class Pattern:
    """A list that the kernel can evaluate.

    Attributes
    ----------
    lookup, decoder : the features, and the network that decodes them
    offset, offset_network : the neural offset, or None
    displace : displacement by traced heights, or None
    shade : shading of the surface, or None
    coordinates : of light and of view that the decoder reads
    half_vector, hints, frame : whether it reads those
    irradiance_scale : factor of the irradiance under the logarithm
    unit : tensor of the unit
    gate : the last operation where the value has a gated core, or None
    factors : names of calibration factors that the value is multiplied by
    """

    lookup: ops.Lookup
    decoder: ops.Network
    offset: ops.Offset | None
    offset_network: ops.Network | None
    displace: ops.Displace | None
    shade: ops.Shade | None
    coordinates: int
    half_vector: bool
    hints: bool
    frame: bool
    irradiance_scale: float
    unit: str
    gate: ops.Gate | None
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
        self._unused = {op.output for op in operations}

    def _take(self, name: str, kind: type[T]) -> T:
        """The operation that computes a value, which must be of a kind."""
        found = self._by_output.get(name)
        if not isinstance(found, kind):
            raise _Unknown
        self._unused.discard(name)
        return found

    def _expect(self, *conditions: bool) -> None:
        if not all(conditions):
            raise _Unknown

    def pattern(self) -> Pattern:
        value, factors = self._factors()
        gate, own = None, value
        if isinstance(self._by_output.get(value), ops.Gate):
            gate = self._take(value, ops.Gate)
            own = gate.plus or ""
        color = self._take(own, ops.Transform)
        self._expect(color.function == "expm1", color.scale == 1.0, color.divisor is None)
        name, _, part = color.x.partition("[")
        decoder = self._take(name, ops.Network)
        self._expect(part in ("", "0:3]"), decoder.outputs == 3 + (gate is not None))
        self._expect(decoder.activation == "relu", color.factor is not None)
        unit = color.factor or ""
        if gate is not None:
            self._expect((gate.floor, gate.scale, gate.unit) == (0.0, 2.0, unit), gate.gate == f"{name}[3:4]")
        features, light, view, *rest = (*decoder.x, "", "", "")[: max(3, len(decoder.x))]
        lookup = self._take(features, ops.Lookup)
        self._expect(lookup.level == "level", lookup.blending == "blend", (light, view) in _LIGHTS)
        half = self._half_vector(rest)
        displace, offset, network = self._moved(lookup.u)
        shade = None
        hints, scale, frame = False, 1.0, False
        if displace is not None:
            shade = self._surface(displace)
            hints, scale = self._hints(rest, shade, unit)
            frame = self._frame(rest, shade)
            self._expect(gate is None or gate.x == f"{shade.output}[3:6]")
        # An operation that nothing above reads changes nothing, but its form is not known.
        self._expect(not rest, not self._unused)
        coordinates = _LIGHTS[light, view]
        return Pattern(
            *(lookup, decoder, offset, network, displace, shade, coordinates, half, hints, frame),
            *(scale, unit, gate, factors),
        )

    def _factors(self) -> tuple[str, tuple[str, ...]]:
        """Name of the value without calibration, and of the factors of calibration."""
        if not isinstance(self._last, ops.Product):
            return self._last.output, ()
        value, *factors = self._take(self._last.output, ops.Product).x
        for name in factors:
            self._take(name, ops.Calibrate)
        return value, tuple(factors)

    def _half_vector(self, rest: list[str]) -> bool:
        if not rest or not isinstance(self._by_output.get(rest[0]), ops.HalfVector):
            return False
        half, difference = self._take(rest[0], ops.HalfVector), self._take(rest[1], ops.Rotate)
        self._expect((difference.axis, difference.omega) == (half.output, "omega_i"))
        del rest[:2]
        return True

    def _moved(self, name: str) -> tuple[ops.Displace | None, ops.Offset | None, ops.Network | None]:
        """How the position that the features are read at is computed."""
        if name == "u":
            return None, None, None
        if isinstance(self._by_output.get(name), ops.Displace):
            displace = self._take(name, ops.Displace)
            self._expect((displace.u, displace.level, displace.omega_o) == ("u", "level", "omega_o"))
            return displace, None, None
        offset = self._take(name, ops.Offset)
        network = self._take(offset.r, ops.Network)
        texture = self._take(network.x[0], ops.Lookup)
        self._expect(
            network.x[1:] == ("omega_o[0:2]",),
            (network.outputs, network.activation) == (1, "relu"),
            (texture.u, texture.level, offset.u, offset.omega_o) == ("u", None, "u", "omega_o"),
        )
        return None, offset, network

    def _surface(self, displace: ops.Displace) -> ops.Shade:
        trace = self._take(displace.z, ops.Trace)
        shades = [op for op in self._by_output.values() if isinstance(op, ops.Shade)]
        self._expect((trace.u, trace.level, trace.omega_o) == ("u", "level", "omega_o"), len(shades) == 1)
        shade = self._take(shades[0].output, ops.Shade)
        read = shade.hits, shade.level, shade.omega_i, shade.omega_o
        self._expect(read == (trace.hits, "level", "omega_i", "omega_o"))
        self._expect(shade.least_variance == LEAST_VARIANCE)
        return shade

    def _hints(self, rest: list[str], shade: ops.Shade, unit: str) -> tuple[bool, float]:
        normal = f"{shade.output}[1:3]"
        if len(rest) < 3 or rest[1] != normal:
            return False, 1.0
        irradiance, core = self._take(rest[0], ops.Transform), self._take(rest[2], ops.Transform)
        self._expect(
            (irradiance.x, irradiance.function, irradiance.factor, irradiance.divisor)
            == (f"{shade.output}[0:1]", "log1p", None, None),
            (core.x, core.function, core.scale, core.factor, core.divisor)
            == (f"{shade.output}[3:6]", "log1p", 1.0, None, unit),
        )
        del rest[:3]
        return True, irradiance.scale

    def _frame(self, rest: list[str], shade: ops.Shade) -> bool:
        if len(rest) < 2:
            return False
        found = [self._take(name, ops.Rotate) for name in rest[:2]]
        normal = f"{shade.output}[1:3]"
        self._expect([(r.axis, r.omega) for r in found] == [(normal, "omega_i"), (normal, "omega_o")])
        del rest[:2]
        return True
