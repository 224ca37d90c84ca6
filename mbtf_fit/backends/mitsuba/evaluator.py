"""M(u, σ, ω_i, ω_o) of a stored material, inside Dr.Jit kernels: its operations, one after the other."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from mbtf_core.errors import InputError
from mbtf_fit.backends.mitsuba import fibers, lookup, network, shade
from mbtf_fit.backends.mitsuba.backend import MITSUBA, Arithmetic, Loader, Numbers, Step
from mbtf_fit.backends.mitsuba.frame import Frame
from mbtf_fit.backends.mitsuba.mixture import Mixture
from mbtf_fit.backends.mitsuba.stored_material import F32, StoredMaterial
from mbtf_fit.backends.mitsuba.textures import Textures
from mbtf_fit.material.format import DESCRIPTION_NAME
from mbtf_fit.material.transmittance import LEAST_COSINE
from mbtf_fit.ops import Operation, Shade, Trace, stages
from mbtf_fit.ops.operation import SAMPLER, output_names
from mbtf_fit.ops.sampler import sampler_sizes
from mbtf_gen.engine.types import Color3f, Float, Point2f, Vector3f

# Operations of files that nothing here names.
__all__ = ["Evaluator", "Values", "fibers"]

# Values by name.
Values = dict[str, Numbers]


class Evaluator:
    """Evaluation of a material for arrays of queries.

    Parameters
    ----------
    stored : operations and tensors of the material
    arithmetic : ``unrolled``, ``cooperative`` or ``half`` networks; the default depends on variant and size

    Attributes
    ----------
    textures : those of the material by the names of their tensors; users may change their texels
    shell : the heights that view rays are traced to; None for a material that has none

    Raises
    ------
    InputError : an operation is not supported, or a tensor is missing or of a wrong shape
    """

    def __init__(self, stored: StoredMaterial, arithmetic: Arithmetic | None = None) -> None:
        self.lattice = stored.lattice
        try:
            MITSUBA.check(stored.operations)
        except InputError as error:
            raise InputError(
                error.what,
                where=stored.folder / DESCRIPTION_NAME,
                hint="PyTorch evaluates this material: mbtf-fit evaluate, or mbtf_fit.Material.load",
            ) from None
        self.arithmetic = network.default_arithmetic(stored) if arithmetic is None else arithmetic
        loader = Loader(stored, self.arithmetic, sampler_sizes(stored.operations, stored.sampler))
        self.textures = loader.textures
        trace = next((op for op in stored.operations if isinstance(op, Trace)), None)
        self.shell = None if trace is None else lookup.shell_of(trace, loader)
        first, second = ([(op, MITSUBA[op](op, loader)) for op in part] for part in stages(stored.operations))
        self._first, self._second, self._last = first, second, stored.operations[-1].output
        self._sampler = [(op, MITSUBA[op](op, loader)) for op in stored.sampler]
        self._shaded = next((op.output for op in stored.operations if isinstance(op, Shade)), None)
        through = stored.transmittance
        layers = [] if through is None else zip(through.depths, through.layers, strict=True)
        self._through = [(z, Textures(levels)) for z, levels in layers]

    def level(self, sigma: Float) -> Float:
        """Fractional level of footprints in tile widths."""
        return dr.clip(-dr.log2(2.0 * sigma), 0.0, float(self.lattice.finest))

    def stage1(self, u: Point2f, level: Float, omega_o: Vector3f, given: Values | None = None) -> Values:
        """Values that do not depend on the light, at uv positions for unit view vectors. Those `given` are
        not computed."""
        values = {"u": list(u), "level": [level], "omega_o": list(omega_o), **(given or {})}
        return _run([step for step in self._first if step[0].output not in values], values)

    def stage2(
        self,
        values: Values,
        omega_i: Vector3f,
        lit: shade.DirectLight | None = None,
        frame: Frame | None = None,
    ) -> Values:
        """All values, from those of stage 1 and unit vectors towards the light, of a tile in a surface's
        frame, `lit` where the surface is curved."""
        return _run(self._second, {**values, "omega_i": list(omega_i)}, lit, frame)

    def value(
        self,
        values: Values,
        omega_i: Vector3f,
        lit: shade.DirectLight | None = None,
        frame: Frame | None = None,
    ) -> Color3f:
        """The value in 1/sr, at least 0, of values of stage 1."""
        found = self.stage2(values, omega_i, lit, frame)
        value = mi.Color3f(*found[self._last])
        if lit is not None:
            # Light below that of the data reaches high places, but little of what others scatter.
            once = mi.Color3f(0.0) if self._shaded is None else mi.Color3f(*found[self._shaded][3:6])
            value = dr.lerp(once, value, lit.known)
        return dr.maximum(value, 0.0)

    def mixture(self, values: Values, viewer: Vector3f) -> Mixture:
        """Density of lights for a view vector, from values of stage 1; the cosine where the material has no
        sampler."""
        if not self._sampler:
            return Mixture.cosine(viewer)
        # Which density a sample is of is not differentiable: gradients through its direction would be biased.
        with dr.suspend_grad():
            return Mixture.of(_run(self._sampler, dict(values))[SAMPLER], viewer)

    def transmittance(self, u: Point2f, level: Float, omega_o: Vector3f) -> Float:
        """Transparent fraction of the footprint for unit vectors on either side of the plane, equal for
        opposite ones. The formula is that of :mod:`mbtf_fit.material.transmittance`."""
        x, y = (dr.mulsign(w, omega_o.z) for w in (omega_o.x, omega_o.y))
        cosine, found = dr.maximum(dr.abs(omega_o.z), LEAST_COSINE), mi.Float(0.0)
        for z, layer in self._through:
            t = z / cosine
            c = layer.blended(mi.Point2f(u.x + t * x, u.y + t * y / self.lattice.aspect), level)
            found += c[0] + c[1] * x + c[2] * y + c[3] * x * x + c[4] * x * y + c[5] * y * y
        return dr.clip(found, 0.0, 1.0)

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
        values = self.stage1(position, self.level(mi.Float(np.asarray(sigma, np.float32))), views)
        out: F32 = np.array(self.value(values, lights), np.float32).T
        return out


def _run(
    steps: Sequence[tuple[Operation, Step]],
    values: Values,
    lit: shade.DirectLight | None = None,
    frame: Frame | None = None,
) -> Values:
    """`values`, and those that the steps of operations compute."""
    for op, step in steps:
        given = {"frame": frame, "lit": lit} if isinstance(op, Shade) else {}
        found = step(*op.arguments(lambda name, part: values[name][part]), **given)
        values.update(zip(output_names(op), found if isinstance(found, tuple) else (found,), strict=True))
    return values
