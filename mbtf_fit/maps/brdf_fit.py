r"""A metallic-roughness BRDF fitted to the values of each texel of a material.

The BRDF is that of glTF 2.0, appendix B. A dielectric of diffuse base color c under a GGX lobe of reflectance
F0 is blended with a metal of GGX alone:

    f = (1 - m) [(1 - F) c / π + F L] + m [c + (1 - c) S] L,    F = F0 + (1 - F0) S,    S = (1 - ω_o·h)^5

with the metallic m, the half vector h and L = D V of the height-correlated Smith masking (Heitz 2014), α the
square of the roughness. F0 = 0 stands for a surface without gloss: F is 0 at all angles. The value is the
radiance for unit irradiance of the reference plane, M = f (n·ω_i) / ω_i.z.

Of each texel the parameters x are slopes, roughness, metallic and base color: those of least

    1/(3k) Σ [φ(f) - φ(y)]² + Σ w (x - x_0)²,    φ(y) = (y / s + ε)^(1/3)

with y the values for k pairs of light and view, and s their mean. The cube root weights dim and bright
directions alike, so that a highlight does not decide alone. Priors favor a rough dielectric. The algorithm
of Levenberg and Marquardt (Marquardt 1963) minimizes it for all texels at once, within bounds.

All texels share the first pairs, which resolve no narrow lobes. The second ones are around the highlight of
each texel's own normal, and confirm or refute a narrow lobe. Their priors are weighted by the residuals: a
lobe that hardly explains more than a rough dielectric is left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbtf_core.data.lattice import texel_centers
from mbtf_fit.maps.reference_values import (
    LEAST_OPACITY,
    direction_pairs,
    followed,
    highlight_pairs,
    least_cosine,
    solid_values,
    steep_views,
)
from mbtf_fit.material.material import Material
from mbtf_fit.threads import one_thread_each

F64 = NDArray[np.float64]
# F0 of a dielectric of refractive index 1.5.
GLTF_DIELECTRIC = 0.04
# Parameters of a texel.
SLOPES, ROUGHNESS, METALLIC, BASE = slice(0, 2), 2, 3, slice(4, 7)
_LOW = torch.tensor([-3.0, -3.0, 0.1, 0.0, 0.0, 0.0, 0.0])
_HIGH = torch.tensor([3.0, 3.0, 1.0, 1.0, 1.0, 1.0, 1.0])
# x_0, and w if nothing is known of the residuals; w of roughness and metallic over the mean square residual.
_PRIOR = torch.tensor([0.0, 0.0, 1.0, 0.0, 0.5, 0.5, 0.5])
_WEAK, _SUPPORT = torch.tensor([1e-4, 1e-4, 3e-4, 3e-4, 1e-5, 1e-5, 1e-5]), 0.1
# ε in units of the mean; decrease of the objective, as a share, at which a texel is done; steps.
_DARK, _DONE, _STEPS = 0.3, 1e-4, 20
# Roughness of the starts, of which the best dielectric and the best metal are minimized, and of a narrow
# lobe, which only the second pairs resolve.
_STARTS, _NARROW = (0.35, 0.6, 1.0), 0.2
# Views that all texels share, and those of the highlights; lights per view of either, fewer for models that
# read a neighborhood.
_VIEWS, _OWN_VIEWS = 32, 16
_LIGHTS, _FEW_LIGHTS = (6, 4), (3, 2)
# Greatest sine of the views: without a neural offset, as parallax blurs what low views see, and with one.
_SINES = (0.5, 0.7)
# Texels that F0 is chosen by. A tile has no gloss if the mean square of its residuals is at most that of a
# glossy tile times a factor, and exceeds it by another factor at a small share of the texels.
_TRIED, _MATTE, _GLOSSY, _SHARE = 256, 1.05, 1.5, 0.02
# Texels that are fitted at once.
_BLOCK = 512
# Least cosine to the normal of what is visible.
_LEAST_COSINE = 1e-6


@dataclass(frozen=True)
class Pairs:
    """Pairs of light and view, k of all texels or (n, k) of each one.

    Attributes
    ----------
    light, view, half : (3, k) or (3, n, k), unit vectors towards light and viewer, and between both
    schlick : (k,) or (n, k), ``(1 - ω_o·h)^5``
    """

    light: Tensor
    view: Tensor
    half: Tensor
    schlick: Tensor

    @classmethod
    def of(cls, omega_i: F64, omega_o: F64, dtype: torch.dtype = torch.float32) -> Pairs:
        """Pairs of unit vectors (..., k, 3), ``z > 0``, which are broadcast."""
        planes = (np.moveaxis(omega, -1, 0) for omega in np.broadcast_arrays(omega_i, omega_o))
        light, view = (torch.from_numpy(np.array(plane, order="C")).to(dtype) for plane in planes)
        half = torch.nn.functional.normalize(light + view, dim=0)
        return cls(light, view, half, (1.0 - (view * half).sum(0).clamp(0.0, 1.0)) ** 5)

    def take(self, some: Tensor) -> Pairs:
        """Those of some texels."""
        return self if self.schlick.ndim == 1 else Pairs(*(a[..., some, :] for a in vars(self).values()))


def reflectance(lobes: Tensor, dielectric: float, pairs: Pairs) -> tuple[Tensor, Tensor]:
    """Value of texels in 1/sr, as ``constant + base_color · factor``, which all three colors share.

    Parameters
    ----------
    lobes : (4, n, 1) or (4, n, k), ∂z/∂x and ∂z/∂y of the shading normal, the square root of α of GGX
        (roughness), the share of metal
    dielectric : F0 of the dielectric
    pairs : k pairs

    Returns
    -------
    (constant, factor) : (n, k) tensors
        0 where the light or the viewer is below the surface.
    """
    p, q, roughness, metal = lobes
    length = (1.0 + p * p + q * q).rsqrt()

    def cosine(omega: Tensor) -> Tensor:
        return (omega[2] - p * omega[0] - q * omega[1]) * length

    light, view, peak = cosine(pairs.light), cosine(pairs.view), cosine(pairs.half).clamp_min(0.0)
    visible = (light > 0) & (view > 0)
    light, view = light.clamp_min(_LEAST_COSINE), view.clamp_min(_LEAST_COSINE)
    alpha2, schlick = roughness**4, pairs.schlick
    rest = 1.0 - alpha2
    masking = light * (view * view * rest + alpha2).sqrt() + view * (light * light * rest + alpha2).sqrt()
    lobe = alpha2 / (2.0 * math.pi * (1.0 - peak * peak * rest) ** 2 * masking)
    fresnel = dielectric + (1.0 - dielectric) * schlick if dielectric > 0 else torch.zeros_like(schlick)
    constant = (fresnel + metal * (schlick - fresnel)) * lobe
    factor = (1.0 - metal) * ((1.0 - fresnel) / math.pi) + metal * (1.0 - schlick) * lobe
    foreshortening = torch.where(visible, light, 0.0) / pairs.light[2]
    return constant * foreshortening, factor * foreshortening


def _root(values: Tensor) -> Tensor:
    return (values.clamp_min(0.0) + _DARK).pow(1.0 / 3.0)


@dataclass(frozen=True)
class _Problem:
    """Least squares of n texels: values (n, 3, k) in units of their mean (n, 1, 1), and φ of them, for k
    pairs of light and view, with the weights (n, 7) of the priors."""

    values: Tensor
    target: Tensor
    mean: Tensor
    pairs: Pairs
    weights: Tensor
    dielectric: float
    least_roughness: float

    @classmethod
    def of(
        cls, values: Tensor, mean: Tensor, pairs: Pairs, dielectric: float, least: float = 0.0
    ) -> _Problem:
        """With weak priors, of values in 1/sr."""
        weights = _WEAK.expand(len(values), 7)
        return cls(values / mean, _root(values / mean), mean, pairs, weights, dielectric, least)

    def take(self, some: Tensor) -> _Problem:
        """That of some texels."""
        names = ("values", "target", "mean", "weights")
        parts = {name: getattr(self, name)[some] for name in names}
        return replace(self, pairs=self.pairs.take(some), **parts)

    @property
    def bounds(self) -> tuple[Tensor, Tensor]:
        """Least and greatest parameters (7,). With an F0 of 0 the surface is rough and no metal."""
        low, high = _LOW.clone(), _HIGH.clone()
        if self.dielectric == 0:
            low[ROUGHNESS], high[METALLIC] = 1.0, 0.0
        else:
            low[ROUGHNESS] = max(float(low[ROUGHNESS]), self.least_roughness)
        return low, high

    def coefficients(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Constant and factor (n, 1, k) of parameters (n, 7), in units of the mean."""
        constant, factor = reflectance(x.T[:4, :, None], self.dielectric, self.pairs)
        return constant[:, None] / self.mean, factor[:, None] / self.mean

    def residuals(self, x: Tensor) -> Tensor:
        """φ(f) - φ(y), (n, 3, k), divided by √(3k)."""
        constant, factor = self.coefficients(x)
        return (_root(constant + x[:, BASE, None] * factor) - self.target) / math.sqrt(self.target[0].numel())

    def linearized(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The residuals (n, 3k), and their derivatives (n, 7, 3k) by the parameters."""
        k = self.target.shape[2]
        # Each pair has a copy of the parameters, so that the gradient of a sum is that of its terms.
        lobes = x.T[:4, :, None].repeat(1, 1, k).requires_grad_()
        coefficients = reflectance(lobes, self.dielectric, self.pairs)
        changes = (torch.autograd.grad(c.sum(), lobes, retain_graph=True)[0] for c in coefficients)
        by_constant, by_factor = (change[:, :, None] / self.mean for change in changes)
        constant, factor = (c.detach()[:, None] / self.mean for c in coefficients)
        base, scale = x[:, BASE, None], math.sqrt(3 * k)
        change = torch.cat([by_constant + base * by_factor, torch.eye(3)[:, None, :, None] * factor])
        root = _root(constant + base * factor)
        jacobian = (change / (3.0 * scale * root.square())).flatten(2).transpose(0, 1)
        return (root - self.target).flatten(1) / scale, jacobian

    def objective(self, x: Tensor) -> Tensor:
        """(n,) of parameters (n, 7)."""
        return self.residuals(x).square().sum((1, 2)) + ((x - _PRIOR).square() * self.weights).sum(1)

    def supported(self, x: Tensor) -> _Problem:
        """With priors of roughness and metallic that a lobe must overcome by what it explains."""
        weights = self.weights.clone()
        weights[:, [ROUGHNESS, METALLIC]] = _SUPPORT * self.residuals(x).square().sum((1, 2))[:, None]
        return replace(self, weights=weights)

    def with_color(self, x: Tensor) -> Tensor:
        """Parameters (n, 7) with the base color of weighted linear least squares."""
        constant, factor = self.coefficients(x)
        weight = (self.values.mean(1, keepdim=True) + _DARK).pow(-2.0 / 3.0)
        base = (weight**2 * factor * (self.values - constant)).sum(2)
        base = (base / (weight * factor).square().sum(2).clamp_min(1e-9)).clamp(0.0, 1.0)
        return torch.cat([x[:, : BASE.start], base], 1)

    def best(self, tried: Sequence[Tensor]) -> Tensor:
        """Of some parameters (n, 7) those of the least objective, for each texel."""
        index = torch.stack([self.objective(x) for x in tried]).argmin(0)
        return torch.stack(list(tried))[index, torch.arange(len(index))]

    def minimize(self, *starts: Tensor) -> Tensor:
        """Parameters (n, 7) of the least of the local minima that some starts lead to."""
        with one_thread_each():
            return self.best([self._descend(x) for x in starts])

    def _descend(self, x: Tensor) -> Tensor:
        """A local minimum, by damped steps of Gauss and Newton."""
        problem, (low, high) = self, self.bounds
        x, active = x.clamp(low, high), torch.arange(len(x))
        out, damping, now = x.clone(), torch.full((len(x),), 1e-2), problem.objective(x)
        for _ in range(_STEPS):
            residuals, jacobian = problem.linearized(x)
            gradient = (jacobian @ residuals[..., None])[..., 0] + problem.weights * (x - _PRIOR)
            hessian = jacobian @ jacobian.transpose(1, 2) + torch.diag_embed(problem.weights)
            # Parameters at a bound beyond which the objective decreases stay there.
            fixed = ((x <= low) & (gradient > 0)) | ((x >= high) & (gradient < 0))
            gradient = torch.where(fixed, 0.0, gradient)
            hessian = torch.where(fixed[:, :, None] | fixed[:, None, :], 0.0, hessian)
            diagonal = torch.where(fixed, 1.0, hessian.diagonal(dim1=1, dim2=2))
            damped = hessian + torch.diag_embed(diagonal * damping[:, None] + fixed)
            step, failed = torch.linalg.solve_ex(damped, -gradient)
            tried = (x + torch.where(failed[:, None] == 0, step, 0.0)).clamp(low, high)
            then = problem.objective(tried)
            better = then < now
            going = ((now - then).abs() > _DONE * now) & (damping < 1e4)
            x, now = torch.where(better[:, None], tried, x), torch.where(better, then, now)
            damping = torch.where(better, 0.2 * damping, 5.0 * damping)
            out[active] = x
            if not going.any():
                break
            active, x, now, damping = active[going], x[going], now[going], damping[going]
            problem = problem.take(going)
        return out


def _starts(problem: _Problem) -> list[Tensor]:
    """Of dielectrics and of metals, the best of some parameters (n, 7): normals by photometric stereo and by
    the highlight, each with some roughness, and the base color of least squares."""
    n, light = len(problem.values), problem.pairs.light
    gray = problem.values.mean(1)
    # Photometric stereo (Woodham 1980): y ω_i.z is linear in the normal, of Lambert, where it is not 0.
    weight = (gray + _DARK).pow(-2.0 / 3.0)
    products = (light[:, None] * light[None, :]).flatten(0, 1)
    matrix = (weight @ products.T).view(n, 3, 3) + 1e-4 * torch.eye(3)
    stereo = torch.linalg.solve(matrix, (weight * gray * light[2]) @ light.T)
    bright = gray.square() @ problem.pairs.half.T
    found = []
    for metallic in (0.0, 1.0) if problem.dielectric > 0 else (0.0,):
        tried = []
        for normal in (torch.tensor([[0.0, 0.0, 1.0]]).expand(n, 3), stereo, bright):
            up = normal[:, 2:].clamp_min(0.3 * normal.norm(dim=1, keepdim=True).clamp_min(1e-9))
            for roughness in _STARTS if problem.dielectric > 0 else (1.0,):
                rest = torch.tensor([roughness, metallic, 0.5, 0.5, 0.5]).expand(n, 5)
                tried.append(problem.with_color(torch.cat([-normal[:, :2] / up, rest], 1)))
        found.append(problem.best(tried))
    return found


def fit_texels(material: Material, level: int, u: F64, dielectric: float) -> tuple[F64, F64, F64]:
    """Fit texels of a level.

    Views are steep, and follow the neural offset to the points that the normal view sees, so that parallax
    blurs no map. Values of a material with holes are divided by what the view meets of it.

    Parameters
    ----------
    material : Material
    level : int
    u : (n, 2), centers of the texels, uv
    dielectric : F0; with 0, roughness is 1 and metallic 0

    Returns
    -------
    parameters : (n, 7) array
        Slopes, roughness, metallic, base color.
    residuals : (n,) array
        Mean squares.
    opacity : (n,) array
        The most that a view meets.
    """
    lights, own = _LIGHTS if material.model.positions == 1 else _FEW_LIGHTS
    moves = any(op.kind() == "offset" for op in material.model.operations)
    least, views = least_cosine(material), steep_views(_VIEWS, _SINES[moves])
    at, omega_o = followed(material, u, views), np.tile(views, (lights, 1))
    omega_i = direction_pairs(_VIEWS * lights, least)[0]
    values, met = solid_values(material, level, np.tile(at, (1, lights, 1)), omega_i, omega_o)
    mean = values.mean((1, 2), keepdim=True).clamp_min(1e-6)
    problem = _Problem.of(values, mean, Pairs.of(omega_i, omega_o), dielectric, _STARTS[0])
    x = problem.minimize(*_starts(problem))
    near_o = np.tile(views[:_OWN_VIEWS], (own, 1))
    near_i = highlight_pairs(x[:, SLOPES].double().numpy(), near_o, least)
    near, _ = solid_values(material, level, np.tile(at[:, :_OWN_VIEWS], (1, own, 1)), near_i, near_o)
    light = np.concatenate([np.broadcast_to(omega_i, (len(u), *omega_i.shape)), near_i], 1)
    pairs = Pairs.of(light, np.concatenate([omega_o, near_o]))
    problem = _Problem.of(torch.cat([values, near], 2), mean, pairs, dielectric)
    if dielectric > 0:
        narrow, rough = x.clone(), x.clone()
        narrow[:, ROUGHNESS], rough[:, ROUGHNESS], rough[:, METALLIC] = _NARROW, 1.0, 0.0
        narrow = problem.best([problem.with_color(narrow), x])
        x = problem.supported(x).minimize(narrow, problem.with_color(rough))
    x = problem.supported(x).minimize(x)
    return x.double().numpy(), problem.residuals(x).square().sum((1, 2)).double().numpy(), met


def fit_tile(
    material: Material, level: int, advance: Callable[[int], None] = lambda _: None
) -> tuple[F64, float]:
    """Fit all texels of a level.

    Parameters
    ----------
    material : Material
    level : int
    advance : called with the number of texels done since the last call

    Returns
    -------
    parameters : (rows, columns, 7) array
        Slopes, roughness, metallic, base color.
    dielectric : float
        F0: that of glTF, 0.04; or 0, with roughness 1, if a tile without gloss agrees as well.
    """
    rows, columns = material.lattice.shape(level)
    u = texel_centers(rows, columns).reshape(-1, 2)
    some = u[np.unique(np.linspace(0, len(u) - 1, min(len(u), _TRIED)).round().astype(int))]
    tried = (fit_texels(material, level, some, f0) for f0 in (0.0, GLTF_DIELECTRIC))
    matte, glossy = (squares[met >= LEAST_OPACITY] for _, squares, met in tried)
    few = np.count_nonzero(matte > _GLOSSY * glossy) <= _SHARE * len(matte)
    dielectric = 0.0 if few and matte.sum() <= _MATTE * glossy.sum() else GLTF_DIELECTRIC
    x, met = np.empty((len(u), 7)), np.empty(len(u))
    for start in range(0, len(u), _BLOCK):
        part = slice(start, start + _BLOCK)
        x[part], _, met[part] = fit_texels(material, level, u[part], dielectric)
        advance(len(u[part]))
    holes = met < LEAST_OPACITY
    if not holes.all():
        # No view meets anything there: the mean color, so that none bleeds in where maps are interpolated.
        x[holes] = np.concatenate([[0.0, 0.0, 1.0, 0.0], x[~holes, BASE].mean(0)])
    return x.reshape(rows, columns, 7), dielectric
