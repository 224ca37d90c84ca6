"""Inputs and output transforms of networks in Dr.Jit, by the options of ``config.network``.

The key ``formula`` of each ``material.json`` states the formulas.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from mbtf_fit.config import EncodingSection, NetworkSection
from mbtf_fit.models.constants import GATE, RGB_OF_YUV
from mbtf_gen.render.types import Color3f, Float, Point2f, Vector3f


def encode(
    p: Sequence[Float],
    bands: int,
    pi: bool,
    options: EncodingSection,
    spread: Sequence[Float] | None = None,
) -> list[Float]:
    """Coordinates → [themselves,] sines of doubling frequencies, cosines; without bands themselves alone.
    With `spread`, their means over Gaussians of these standard deviations."""
    if bands == 0:
        return list(p)
    unit = math.pi if pi else 1.0
    frequencies = [unit * 2.0**k for k in range(bands)]
    pairs = [dr.sincos(x * f) for x in p for f in frequencies]
    if options.band_attenuation:
        pairs = [(s * 0.5**k, c * 0.5**k) for (s, c), k in zip(pairs, [*range(bands)] * len(p), strict=True)]
    if spread is not None:
        left = [dr.exp(-0.5 * dr.square(s * f)) for s in spread for f in frequencies]
        pairs = [(s * a, c * a) for (s, c), a in zip(pairs, left, strict=True)]
    return [*(p if options.raw else ()), *(s for s, _ in pairs), *(c for _, c in pairs)]


def encode_direction(omega: Vector3f, options: EncodingSection) -> list[Float]:
    """Encoded direction."""
    coordinates = [omega.x, omega.y, omega.z] if options.direction_xyz else [omega.x, omega.y]
    return encode(coordinates, options.direction, options.direction_pi, options)


def encode_position(u: Point2f, level: Float, aspect: float, options: EncodingSection) -> list[Float]:
    """Encoded uv position at a fractional level: empty without bands."""
    if options.position == 0:
        return []
    p = [2.0 * (x - dr.floor(x)) - 1.0 for x in (u.x, u.y)]
    spread = None
    if options.footprint_filtered:
        across = dr.exp2(-level)
        spread = [across, across / aspect]
    return encode(p, options.position, options.pi, options, spread)


def _mapped(x: Float, name: str) -> Float:
    if name == "expm1":
        return dr.exp(x) - 1.0
    if name == "exp":
        return dr.exp(x)
    if name == "softplus":
        return dr.maximum(x, 0.0) + dr.log(1.0 + dr.exp(-dr.abs(x)))
    if name == "fourth-root":
        return x * dr.square(x) * dr.abs(x)
    return x


def to_value(x: Sequence[Float], unit: float, network: NetworkSection) -> Color3f:
    """Value in 1/sr, at least 0, of a decoder's outputs."""
    if len(x) == 3:
        colors = [unit * _mapped(v, network.output_transform) for v in x]
    else:
        rgb = [sum(weight * v for weight, v in zip(row, x[:3], strict=True) if weight) for row in RGB_OF_YUV]
        gates = [GATE + dr.rcp(1.0 + dr.exp(-v)) for v in x[3:]]
        colors = [
            unit * _mapped(v, network.output_transform) * gate for v, gate in zip(rgb, gates, strict=True)
        ]
    return mi.Color3f(*(dr.maximum(v, 0.0) for v in colors))
