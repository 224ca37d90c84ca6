"""M(u, σ, ω_i, ω_o) of a stored material, inside Dr.Jit kernels.

The keys ``formula`` and ``conventions`` of ``material.json`` state the formulas;
:mod:`mbtf_fit.models.neumip` explains them.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from mbtf_fit.mitsuba_plugin.calibration_factors import CalibrationFactors
from mbtf_fit.mitsuba_plugin.encodings import encode_direction, encode_position, to_value
from mbtf_fit.mitsuba_plugin.material_arrays import F32, StoredMaterial
from mbtf_fit.mitsuba_plugin.network import (
    MOST_UNROLLED,
    Arithmetic,
    Network,
    count_weights,
    default_arithmetic,
)
from mbtf_fit.mitsuba_plugin.textures import Textures
from mbtf_fit.models.constants import GRAZING, OFFSET_SCALE
from mbtf_gen.render.types import Color3f, Float, Point2f, Vector3f


class Evaluator:
    """Evaluation of a material for arrays of queries.

    Parameters
    ----------
    stored : StoredMaterial
        Weights of the material.
    arithmetic : str, optional
        Evaluation of the networks: ``unrolled``, ``cooperative`` or ``half``. The default depends on variant
        and size.
    """

    def __init__(self, stored: StoredMaterial, arithmetic: Arithmetic | None = None) -> None:
        self.lattice = stored.lattice
        self.network = stored.network
        self.unit = stored.unit
        weights = count_weights(stored.decoder) + count_weights(stored.offset_network or [])
        self.arithmetic: Arithmetic = default_arithmetic(weights) if arithmetic is None else arithmetic
        self.factors = None if stored.calibration is None else CalibrationFactors(stored.calibration)
        self.pyramid = Textures(stored.pyramid)
        self.coefficients = None if stored.transmittance is None else Textures(stored.transmittance)
        self.decoder = Network(stored.decoder, self.arithmetic, stored.network.activation)
        self.offset_texture: Textures | None = None
        if stored.offset_texture is not None and stored.offset_network is not None:
            self.offset_texture = Textures([stored.offset_texture])
            self.offset_network = Network(
                stored.offset_network, self._offset_arithmetic(stored), stored.network.activation
            )

    def _offset_arithmetic(self, stored: StoredMaterial) -> Arithmetic:
        """Single precision for small networks: the value is sensitive to errors of the offset."""
        small = count_weights(stored.offset_network or []) <= MOST_UNROLLED
        return "unrolled" if self.arithmetic == "half" and small else self.arithmetic

    def level(self, sigma: Float) -> Float:
        """Fractional level of footprints in tile widths."""
        return dr.clip(-dr.log2(2.0 * sigma), 0.0, float(self.lattice.finest))

    def features(self, u: Point2f, level: Float, omega_o: Vector3f) -> list[Float]:
        """Stage 1, independent of the light: features at uv positions for unit view vectors, followed by the
        calibration factors of the view and the level, where the material has some."""
        moved = u
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
        features = [*read(moved, level), *encoded]
        return (
            features if self.factors is None else [*features, *self.factors.by_view(level, omega_o.z), level]
        )

    def value(self, features: list[Float], omega_i: Vector3f, omega_o: Vector3f) -> Color3f:
        """Stage 2: value in 1/sr, at least 0."""
        options = self.network.encoding
        directions = [*encode_direction(omega_i, options), *encode_direction(omega_o, options)]
        if self.factors is None:
            return to_value(self.decoder([*features, *directions]), self.unit, self.network)
        *features, red, green, blue, level = features
        value = to_value(self.decoder([*features, *directions]), self.unit, self.network)
        return value * mi.Color3f(red, green, blue) * self.factors.by_light(level, omega_i.z)

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
