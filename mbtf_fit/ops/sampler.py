r"""The sampler of a material: a small network that says where light matters, for importance sampling.

From values of stage 1 it predicts, for each position, footprint and view, a mixture of two densities of ω_i
(Zeltner et al. 2024). One is the cosine-weighted hemisphere, the other reflects the view at the visible
normals of an anisotropic, tilted GGX distribution. Its slopes are ``s = L t + s0`` with t distributed as
``1/(π (1+|t|²)²)``. The normal ``(-s, 1)`` is then ``K (-t, 1)`` with ``K = [[L, -s0], [0, 1]]``, so that the
normals visible from ω are the images of the normals of a unit GGX visible from ``ω' = Kᵀω`` (Heitz 2018;
there without the tilt), and the density of the reflected direction is

    (S1) p(ω_i) = D(h) / (2 (|ω'| + ω'_z)),   D(h) = 1 / (π |det L| (1+|t|²)² h_z⁴).

Directions below the plane are discarded, so the density integrates to less than one. The network's six
outputs x give

    (S2) L = [[ε + e^min(x0, m), 0], [x1 L22, ε + e^min(x2, m)]],   s0 = (x3, x4),   weight = w σ(x5)

of the reflection, with the constants below. A mixture keeps some cosine, so every direction has a density.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mbtf_fit.ops.constants import MAP_CHANNELS
from mbtf_fit.ops.lookup import Displace, Offset, SurfaceMaps, Trace
from mbtf_fit.ops.network import Network
from mbtf_fit.ops.operation import (
    SAMPLER,
    Operation,
    input_sizes,
    output_names,
    parse,
    parse_operations,
    sizes_of,
    stages,
)
from mbtf_fit.ops.shade import Shade
from mbtf_fit.ops.value import Calibrate

HIDDEN, OUTPUTS = (16, 16), 6
# (S2) Smallest α, ε, as values are blurred by the light; largest logarithm m; largest weight w.
LEAST_ALPHA, LARGEST_LOG, LARGEST_WEIGHT = BOUNDS = 0.02, 3.0, 0.98
# Operations whose results say nothing of the surface: positions and factors.
_OTHERS = (Trace, Displace, Offset, Calibrate)


def sampler_of(operations: Sequence[Operation], channels: int) -> list[Operation]:
    """The operations of a material's sampler, from those of its value.

    Parameters
    ----------
    channels : of the maps of its surface, if it has one
    """
    first, second = stages(operations)
    read = {parse(reference)[0] for op in second for reference in op.inputs()}
    values = [n for op in first if not isinstance(op, _OTHERS) for n in output_names(op) if n in read]
    shade = next((op for op in second if isinstance(op, Shade)), None)
    out: list[Operation] = []
    if shade is not None:
        name, part = parse(shade.hits)
        start = part.start or 0
        hit = f"{name}[{start}:{start + 2}]"
        out.append(SurfaceMaps("sampler_maps", hit, shade.level, shade.maps, channels, shade.finer))
        values.append("sampler_maps[0:5]")
        # All but the base color.
        values += [f"sampler_maps[8:{channels}]"] * (channels > MAP_CHANNELS[0])
    out.append(Network(SAMPLER, (*values, "omega_o", "level"), SAMPLER, HIDDEN, OUTPUTS))
    return out


def read_sampler(data: Any, operations: Sequence[Operation], tensors: Mapping[str, Any]) -> list[Operation]:
    """The operations of a sampler from plain data, for a material of other operations and of arrays by name.

    Raises
    ------
    ValueError : they are none of :func:`sampler_of`
    """
    maps = next((tensors.get(f"{op.maps}.0") for op in operations if isinstance(op, Shade)), None)
    out = parse_operations(data)
    if out != sampler_of(operations, 0 if maps is None else maps.shape[-1]):
        raise ValueError("its sampler is not that of its operations")
    return out


def sampler_sizes(operations: Sequence[Operation], sampler: Sequence[Operation]) -> dict[str, int]:
    """Size of every value of a material and of its sampler, if it has one.

    Raises
    ------
    ValueError : an operation reads an unknown value, or one of a wrong size
    """
    sizes = sizes_of(operations)
    for op in sampler:
        sizes |= op.results(input_sizes(op, sizes))
    return sizes
