r"""Least squares of the metallic-roughness BRDF to the values of texels.

Of each texel the parameters are slopes, roughness, metallic and base color: those of least

    1/(3k) Σ [φ(f) - φ(y)]² + Σ w (x - x_0)²,    φ(y) = (y / s + ε)^(1/3)

with y the values for k pairs of light and view, and s their mean. The cube root weights dim and bright
directions alike, so that a highlight does not decide alone. Priors favor a rough dielectric. The
algorithm of Levenberg and Marquardt (Marquardt 1963), with bounds, minimizes it for many texels at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mbtf_fit.material.interchange.brdf import Pairs, affine, affine_derivatives

# Indices of the parameters of a texel: slopes, roughness, metallic, base color.
SLOPES, ROUGHNESS, METALLIC, BASE = slice(0, 2), 2, 3, slice(4, 7)
_LOW = (-3.0, -3.0, 0.1, 0.0, 0.0, 0.0, 0.0)
_HIGH = (3.0, 3.0, 1.0, 1.0, 1.0, 1.0, 1.0)
# Values towards which priors pull, and their weights if nothing is known of the residuals.
_PRIOR = torch.tensor([0.0, 0.0, 1.0, 0.0, 0.5, 0.5, 0.5])
WEAK = torch.tensor([1e-4, 1e-4, 3e-4, 3e-4, 1e-5, 1e-5, 1e-5])
# ε in units of the mean; decrease of the objective, as a share, at which a texel is done.
_DARK, _DONE = 0.3, 1e-4
# Roughness and metallic of the starts: dielectrics, metals.
_STARTS = [[(r, m) for r in (0.35, 0.6, 1.0)] for m in (0.0, 1.0)]


def _root(values: Tensor) -> Tensor:
    return (values.clamp_min(0.0) + _DARK).pow(1.0 / 3.0)


@dataclass(frozen=True)
class Problem:
    """Least squares of a block of n texels.

    Attributes
    ----------
    target : (n, 3, k) tensor
        φ of the values.
    scale : (n, 1) tensor
        Mean values s.
    pairs : Pairs
        In single precision.
    dielectric : float
        F0; with 0, roughness is 1 and metallic 0.
    least_roughness : float
    weights : (n, 7) tensor
        Weights w of the priors.
    """

    target: Tensor
    scale: Tensor
    pairs: Pairs
    dielectric: float
    least_roughness: float
    weights: Tensor

    @classmethod
    def of(
        cls, values: Tensor, scale: Tensor, pairs: Pairs, dielectric: float, least_roughness: float
    ) -> Problem:
        """With weak priors, of values (n, 3, k) in 1/sr."""
        target = _root(values / scale[:, None])
        return cls(target, scale, pairs, dielectric, least_roughness, WEAK.expand(len(values), 7))

    @property
    def bounds(self) -> tuple[Tensor, Tensor]:
        """Least and greatest parameters (7,). With an F0 of 0 the surface is rough and no metal."""
        low, high = torch.tensor(_LOW), torch.tensor(_HIGH)
        if self.dielectric == 0:
            low[ROUGHNESS], high[METALLIC] = 1.0, 0.0
        else:
            low[ROUGHNESS] = max(float(low[ROUGHNESS]), self.least_roughness)
        return low, high

    def coefficients(self, x: Tensor) -> tuple[Tensor, Tensor]:
        constant, factor = affine(
            x[:, SLOPES], x[:, ROUGHNESS] ** 4, x[:, METALLIC], self.dielectric, self.pairs
        )
        return constant / self.scale, factor / self.scale

    def residuals(self, x: Tensor) -> Tensor:
        """Mean square (n,) of the residuals of parameters (n, 7)."""
        constant, factor = self.coefficients(x)
        values = constant[:, None] + x[:, BASE, None] * factor[:, None]
        return (_root(values) - self.target).square().mean((1, 2))

    def objective(self, x: Tensor) -> Tensor:
        """(n,) of parameters (n, 7)."""
        return self.residuals(x) + ((x - _PRIOR).square() * self.weights).sum(1)

    def linearized(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Half the gradient (n, 7) of the objective, and half of Gauss and Newton's Hessian (n, 7, 7)."""
        n, k = len(x), self.target.shape[2]
        roughness = x[:, ROUGHNESS]
        constant, factor, by_constant, by_factor = affine_derivatives(
            x[:, SLOPES], roughness**4, x[:, METALLIC], self.dielectric, self.pairs
        )
        chain = torch.ones(n, 4)
        chain[:, ROUGHNESS] = 4.0 * roughness**3
        chain = (chain / self.scale)[:, :, None]
        by_constant, by_factor = by_constant * chain, by_factor * chain
        constant, factor = constant / self.scale, factor / self.scale
        base = x[:, BASE, None]
        root = _root(constant[:, None] + base * factor[:, None])
        gain = (1.0 / 3.0) / root.square()
        jacobian = torch.zeros(n, 7, 3, k)
        for c in range(3):
            torch.add(by_constant, by_factor * base[:, c, None], out=jacobian[:, :4, c])
            torch.mul(gain[:, c], factor, out=jacobian[:, 4 + c, c])
        jacobian[:, :4] *= gain[:, None]
        jacobian = jacobian.view(n, 7, 3 * k)
        residual = (root - self.target).reshape(n, 3 * k, 1)
        gradient = (jacobian @ residual)[..., 0] / (3 * k) + self.weights * (x - _PRIOR)
        hessian = jacobian @ jacobian.transpose(1, 2) / (3 * k) + torch.diag_embed(self.weights)
        return gradient, hessian

    def take(self, some: Tensor) -> Problem:
        """The problem of some of the texels."""
        return replace(
            self,
            target=self.target[some],
            scale=self.scale[some],
            pairs=self.pairs.take(some),
            weights=self.weights[some],
        )


def with_color(problem: Problem, values: Tensor, x: Tensor) -> Tensor:
    """Parameters (n, 7) with the base color of weighted least squares, of values (n, 3, k)."""
    constant, factor = problem.coefficients(x)
    values = values / problem.scale[:, None]
    weight = (values.mean(1) + _DARK).pow(-2.0 / 3.0)
    trusted = (weight * factor)[:, None]
    base = (trusted * weight[:, None] * (values - constant[:, None])).sum(2)
    base = (base / trusted.square().sum(2).clamp_min(1e-9)).clamp(0.0, 1.0)
    return torch.cat([x[:, :4], base], 1)


def starts(problem: Problem, values: Tensor) -> list[Tensor]:
    """Of dielectrics and of metals, the best of some parameters (n, 7): normals by photometric stereo and by
    the highlight, each with some roughness, and the base color of least squares.

    `values` (n, 3, k) are of pairs that all texels share.
    """
    n, pairs = len(values), problem.pairs
    gray = (values / problem.scale[:, None]).mean(1)
    # Photometric stereo (Woodham 1980): y ω_i.z is linear in the normal, of Lambert, where it is not 0.
    weight = (gray + _DARK).pow(-2.0 / 3.0)
    lights = pairs.omega_i
    product = lights[:, :, None] * lights[:, None, :]
    matrix = (weight @ product.reshape(-1, 9)).view(n, 3, 3) + 1e-4 * torch.eye(3)
    stereo = torch.linalg.solve(matrix, (weight * gray * lights[:, 2]) @ lights)
    bright = gray.square() @ pairs.half
    found = []
    for lobes in _STARTS:
        best, least = torch.zeros(n, 7), torch.full((n,), torch.inf)
        for normal in (torch.tensor([[0.0, 0.0, 1.0]]).expand(n, 3), stereo, bright):
            up = normal[:, 2:].clamp_min(0.3 * normal.norm(dim=1, keepdim=True).clamp_min(1e-9))
            slopes = -normal[:, :2] / up
            for roughness, metallic in lobes:
                x = torch.cat([slopes, torch.tensor([[roughness, metallic, 0.5, 0.5, 0.5]]).expand(n, 5)], 1)
                x = with_color(problem, values, x)
                objective = problem.objective(x)
                better = objective < least
                best[better], least[better] = x[better], objective[better]
        found.append(best)
    return found


def minimize_best(problem: Problem, tried: list[Tensor], steps: int) -> Tensor:
    """Parameters (n, 7) of the better of two local minima, after few steps."""
    first, second = (minimize(problem, x, steps) for x in tried)
    return torch.where((problem.objective(first) < problem.objective(second))[:, None], first, second)


def minimize(problem: Problem, x: Tensor, steps: int) -> Tensor:
    """Parameters (n, 7) of a local minimum, from a start."""
    low, high = problem.bounds
    x, active = x.clamp(low, high), torch.arange(len(x))
    out, damping = x.clone(), torch.full((len(x),), 1e-2)
    now = problem.objective(x)
    for _ in range(steps):
        gradient, hessian = problem.linearized(x)
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
        done = (now - then).abs() <= _DONE * now
        x, now = torch.where(better[:, None], tried, x), torch.where(better, then, now)
        damping = torch.where(better, 0.2 * damping, 5.0 * damping)
        out[active] = x
        going = ~done & (damping < 1e4)
        if not going.any():
            break
        if going.float().mean() < 0.7:
            active, x, now, damping = active[going], x[going], now[going], damping[going]
            problem = problem.take(going)
    return out
