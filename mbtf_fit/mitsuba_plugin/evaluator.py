"""M(u, σ, ω_i, ω_o) of a stored material, inside Dr.Jit kernels.

The keys ``formula`` and ``conventions`` of ``material.json`` state the formulas;
:mod:`mbtf_fit.models.neumip` explains them.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from mbtf_fit.mitsuba_plugin.known_surface import KnownSurface, displaced
from mbtf_fit.mitsuba_plugin.material_arrays import F32, StoredMaterial
from mbtf_fit.mitsuba_plugin.network import (
    MOST_UNROLLED,
    Arithmetic,
    Network,
    count_weights,
    default_arithmetic,
    encode_directions,
    encode_position,
    rotate_to_z,
    to_value,
)
from mbtf_fit.mitsuba_plugin.textures import Textures
from mbtf_fit.ops.constants import GRAZING, IRRADIANCE_SCALE, LEAST_COSINE, OFFSET_SCALE, STATISTICS
from mbtf_gen.engine.types import Color3f, Float, Point2f, UInt32, Vector3f


class CalibrationFactors:
    """Calibration tables (2, levels, knots, 3) of a material, by light and by view; the formula is that of
    :class:`mbtf_fit.ops.Calibrate`."""

    def __init__(self, tables: F32) -> None:
        _, self._levels, self._knots, _ = tables.shape
        self._buffer = mi.Float(np.pad(tables, ((0, 0), (0, 0), (0, 0), (0, 1))).reshape(-1))
        dr.eval(self._buffer)

    def at(self, table: int, level: Float, cosine: Float) -> Color3f:
        """Factors of the light's cosine (table 0) or of the view's (1) at fractional levels."""
        x = dr.clip(cosine, 0.0, 1.0) * (self._knots - 1)
        left = dr.minimum(mi.UInt32(x), self._knots - 2)
        inside = x - mi.Float(left)
        if self._levels == 1:
            return self._along(table * self._knots + left, inside)
        level = dr.clip(level, 0.0, self._levels - 1.0)
        coarse = dr.minimum(mi.UInt32(level), self._levels - 2)
        first = (table * self._levels + coarse) * self._knots + left
        pair = (self._along(first, inside), self._along(first + self._knots, inside))
        return dr.lerp(*pair, level - mi.Float(coarse))

    def _along(self, first: UInt32, inside: Float) -> Color3f:
        pair = (dr.gather(mi.Vector4f, self._buffer, first + k) for k in (0, 1))
        found = dr.lerp(*pair, inside)
        return mi.Color3f(found.x, found.y, found.z)


class Evaluator:
    """Evaluation of a material for arrays of queries.

    Parameters
    ----------
    stored : weights of the material
    arithmetic : ``unrolled``, ``cooperative`` or ``half`` networks; the default depends on variant and size
    """

    def __init__(self, stored: StoredMaterial, arithmetic: Arithmetic | None = None) -> None:
        self.lattice = stored.lattice
        self.network = stored.network
        self.sliced = stored.sliced
        self.unit = stored.unit
        weights = count_weights(stored.decoder) + count_weights(stored.offset_network or [])
        self.arithmetic: Arithmetic = default_arithmetic(weights) if arithmetic is None else arithmetic
        self.factors = None if stored.calibration is None else CalibrationFactors(stored.calibration)
        self.pyramid = Textures(stored.pyramid)
        self.coefficients = None if stored.transmittance is None else Textures(stored.transmittance)
        self.decoder = Network(stored.decoder, self.arithmetic, stored.network.activation)
        self.surface: KnownSurface | None = None
        if stored.surface is not None:
            self.surface = KnownSurface(stored.surface, stored.lattice, stored.network.relief.places)
            self._depth_weights = mi.Float(stored.surface.depth_weights)
        self.offset_texture: Textures | None = None
        if stored.offset_texture is not None and stored.offset_network is not None:
            self.offset_texture = Textures([stored.offset_texture])
            # Single precision for small networks: the value is sensitive to errors of the offset.
            small = self.arithmetic == "half" and count_weights(stored.offset_network) <= MOST_UNROLLED
            self.offset_network = Network(
                stored.offset_network, "unrolled" if small else self.arithmetic, stored.network.activation
            )

    def level(self, sigma: Float) -> Float:
        """Fractional level of footprints in tile widths."""
        return dr.clip(-dr.log2(2.0 * sigma), 0.0, float(self.lattice.finest))

    def features(self, u: Point2f, level: Float, omega_o: Vector3f) -> list[Float]:
        """Stage 1, independent of the light: features at uv positions for unit view vectors, followed by what
        is known of the surface there, the calibration factors of the view and the level, where the material
        has some."""
        moved = u
        known: list[Float] = []
        if self.surface is not None:
            height, known = self.surface.intersections(u, level, omega_o)
            moved = displaced(u, self._depth_weight(level) * height, omega_o, self.lattice.aspect)
            known = [*known, level]
        if self.offset_texture is not None:
            r = self.offset_network([*self.offset_texture.first(u), omega_o.x, omega_o.y])
            if len(r) == 1:
                r = [r[0] * (omega / dr.maximum(omega_o.z, GRAZING)) for omega in (omega_o.x, omega_o.y)]
            x, y = r
            moved = mi.Point2f(
                dr.fma(x, OFFSET_SCALE, u.x), dr.fma(y, OFFSET_SCALE / self.lattice.aspect, u.y)
            )
        read = self.pyramid.blended if self.network.blending == "blend" else self.pyramid.side_by_side
        encoded = encode_position(u, level, self.lattice.aspect, self.network.encoding)
        features = [*read(moved, level), *encoded, *known]
        return features if self.factors is None else [*features, *self.factors.at(1, level, omega_o.z), level]

    def value(self, features: list[Float], omega_i: Vector3f, omega_o: Vector3f) -> Color3f:
        """Stage 2: value in 1/sr, at least 0."""
        inputs = features if self.factors is None else features[:-4]
        value = self._decode(inputs, omega_i, omega_o)
        if self.factors is None:
            return value
        *by_view, level = features[-4:]
        return value * mi.Color3f(*by_view) * self.factors.at(0, level, omega_i.z)

    def _depth_weight(self, level: Float) -> Float:
        """Weight of the displacement at fractional levels."""
        if self.lattice.finest == 0:
            return dr.gather(mi.Float, self._depth_weights, mi.UInt32(0))
        coarse = dr.minimum(mi.UInt32(level), self.lattice.finest - 1)
        pair = (dr.gather(mi.Float, self._depth_weights, coarse + k) for k in (0, 1))
        return dr.lerp(*pair, level - mi.Float(coarse))

    def _decode(self, features: list[Float], omega_i: Vector3f, omega_o: Vector3f) -> Color3f:
        """Value of features without calibration."""
        if self.sliced:
            return self._of_slices(features, omega_i, omega_o)
        directions = encode_directions(omega_i, omega_o, self.network.encoding)
        if self.surface is None:
            return to_value(self.decoder([*features, *directions]), self.unit, self.network)
        relief = self.network.relief
        count = relief.places * self.surface.numbers + 1
        learned, known, level = features[:-count], features[-count:-1], features[-1]
        irradiance, x, y, *core = self.surface.shading(known, level, omega_i, omega_o)
        # Black data have no unit: their value is 0.
        unit = self.unit or 1.0
        core = [c if self.unit else 0.0 * c for c in core]
        inputs = [*learned, *directions]
        if relief.hints:
            logarithms = (dr.log(1.0 + c / unit) for c in core)
            inputs += [dr.log(dr.fma(IRRADIANCE_SCALE, irradiance, 1.0)), x, y, *logarithms]
        if relief.frame:
            normal = mi.Vector3f(x, y, dr.safe_sqrt(1.0 - dr.fma(x, x, y * y)))
            for omega in (omega_i, omega_o):
                inputs += [*rotate_to_z(normal, omega)]
        out = self.decoder(inputs)
        if not relief.gate:
            return to_value(out, self.unit, self.network)
        gate = 2.0 / (1.0 + dr.exp(-out[-1]))
        return dr.maximum(
            to_value(out[:-1], self.unit, self.network, clamp=False) + gate * mi.Color3f(*core), 0.0
        )

    def _of_slices(self, features: list[Float], omega_i: Vector3f, omega_o: Vector3f) -> Color3f:
        """Value of latents, means and deviations; the formula is that of :mod:`mbtf_fit.models.rainer`."""
        latents, mean, deviation = features[:-STATISTICS], features[-6:-3], features[-3:]
        projected = [c * dr.rcp(1.0 + w.z) for w in (omega_i, omega_o) for c in (w.x, w.y)]
        x = self.decoder([*latents, *projected])
        scale = self.unit / dr.maximum(omega_i.z, LEAST_COSINE)
        parts = zip(mean, deviation, x, strict=True)
        return mi.Color3f(*(dr.maximum(scale * (dr.exp(dr.fma(d, v, m)) - 1.0), 0.0) for m, d, v in parts))

    def transmittance(self, u: Point2f, level: Float, omega_o: Vector3f) -> Float:
        """Transparent fraction of the footprint for unit vectors on either side of the plane, equal for
        opposite ones. The formula is that of :mod:`mbtf_fit.material.transmittance`."""
        if self.coefficients is None:
            return mi.Float(0.0)
        x, y = (dr.mulsign(w, omega_o.z) for w in (omega_o.x, omega_o.y))
        c = self.coefficients.blended(u, level)
        value = c[0] + c[1] * x + c[2] * y + c[3] * x * x + c[4] * x * y + c[5] * y * y
        return dr.clip(value, 0.0, 1.0)

    def evaluate(self, u: ArrayLike, sigma: ArrayLike, omega_i: ArrayLike, omega_o: ArrayLike) -> F32:
        """Evaluate arrays of queries like :meth:`mbtf_fit.Material.evaluate`.

        Parameters
        ----------
        u : (n, 2) float array
            Positions on the reference plane, uv; the tile repeats.
        sigma : (n,) float array
            Standard deviations of the footprints in tile widths.
        omega_i, omega_o : (n, 3) float array
            Unit vectors towards light and viewer, z > 0.

        Returns
        -------
        (n, 3) float32 array
            Values in 1/sr, linear RGB, at least 0.
        """
        position = mi.Point2f(np.asarray(u, np.float32).T)
        lights, views = (mi.Vector3f(np.asarray(w, np.float32).T) for w in (omega_i, omega_o))
        features = self.features(position, self.level(mi.Float(np.asarray(sigma, np.float32))), views)
        out: F32 = np.array(self.value(features, lights, views), np.float32).T
        return out
