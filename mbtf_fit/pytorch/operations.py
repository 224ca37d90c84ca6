"""The operations in PyTorch: one function each, with the equations of :mod:`mbtf_fit.ops`.

Arrays are (queries, numbers); levels are (queries,). Behind a :class:`~mbtf_fit.ops.lookup.Neighborhood`
there are more rows, those of each query one after the other."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from mbtf_core.data.lattice import Lattice
from mbtf_fit import ops
from mbtf_fit.ops.constants import HEIGHT_SCALE, LEAST_FACING
from mbtf_fit.pytorch.textures import FeatureTextures
from mbtf_fit.surface.facets import fresnel
from mbtf_fit.surface.known import KnownSurface
from mbtf_fit.surface.lookup import coarse_level, lookup

# Of each function its code, and the x whose value is 1; 0 for expm1.
FUNCTIONS: dict[str, tuple[Callable[[Tensor], Tensor], float]] = {
    "identity": (lambda x: x, 1.0),
    "exp": (torch.exp, 0.0),
    "expm1": (torch.expm1, 0.0),
    "log1p": (torch.log1p, math.e - 1.0),
    "softplus": (torch.nn.functional.softplus, math.log(math.e - 1.0)),
    "sigmoid": (torch.sigmoid, 0.0),
    # Odd, so that the gradient has the right sign for outputs below zero.
    "fourth-root": (lambda x: x * x.abs().pow(3), 1.0),
    "square": (torch.square, 1.0),
}


class Tensors(Protocol):
    """What operations read of a material: texel grids, surface, and tensors by name."""

    lattice: Lattice

    @property
    def known(self) -> KnownSurface: ...

    def texture(self, name: str) -> FeatureTextures: ...

    def number(self, name: str) -> Tensor: ...

    def get_submodule(self, target: str) -> torch.nn.Module: ...


@dataclass(frozen=True)
class Execution:
    """One evaluation: of a material, and (rows, columns) of positions per query where they are given."""

    material: Tensors
    grid: tuple[int, int] | None = None

    @property
    def aspect(self) -> float:
        """Height of the tile over its width."""
        return self.material.lattice.aspect


PYTORCH: ops.Backend[Callable[..., Tensor | tuple[Tensor, ...]]] = ops.Backend("PyTorch")


def _per_width(run: Execution, like: Tensor) -> Tensor:
    """(1, aspect)"""
    return like.new_tensor([1.0, run.aspect])


@PYTORCH.implements(ops.Lookup)
def _lookup(op: ops.Lookup, run: Execution, u: Tensor, level: Tensor | None) -> Tensor:
    return run.material.texture(op.textures)(u, None if level is None else level + op.finer)


@PYTORCH.implements(ops.Neighborhood)
def _neighborhood(op: ops.Neighborhood, run: Execution, u: Tensor, level: Tensor) -> Tensor:
    lattice = run.material.lattice
    shapes = u.new_tensor([lattice.shape(s) for s in range(lattice.finest + 1)])
    rows, columns = shapes[(level + 0.5).floor().long()].unbind(1)
    steps = torch.arange(-op.margin, op.margin + 1, dtype=u.dtype, device=u.device)
    along_u = u[:, :1] + steps / columns[:, None]
    along_v = u[:, 1:] - steps / rows[:, None]
    size = len(steps)
    grid = [along_u[:, None].expand(-1, size, -1), along_v[:, :, None].expand(-1, -1, size)]
    return torch.stack(grid, -1).view(-1, 2)


@PYTORCH.implements(ops.Offset)
def _offset(op: ops.Offset, run: Execution, u: Tensor, r: Tensor, omega_o: Tensor) -> Tensor:
    return u + displacement(op, r, omega_o) / _per_width(run, u)


def displacement(op: ops.Offset, r: Tensor, omega_o: Tensor) -> Tensor:
    """Neural offset (n, 2) in tile widths, of the network's output r."""
    r = op.scale * r
    return r if r.shape[1] == 2 else r * (omega_o[:, :2] / omega_o[:, 2:].clamp_min(op.grazing))


@PYTORCH.implements(ops.Trace)
def _trace(op: ops.Trace, run: Execution, u: Tensor, level: Tensor, omega_o: Tensor) -> tuple[Tensor, ...]:
    return run.material.known.intersections(op, u, level, omega_o)


@PYTORCH.implements(ops.SurfaceMaps)
def _surface_maps(op: ops.SurfaceMaps, run: Execution, u: Tensor, level: Tensor) -> Tensor:
    return run.material.known.read_maps(u, level + op.finer)


@PYTORCH.implements(ops.Displace)
def _displace(
    op: ops.Displace, run: Execution, u: Tensor, z: Tensor, level: Tensor, omega_o: Tensor
) -> Tensor:
    weights, aspect = run.material.number(op.weights), _per_width(run, u)
    coarse, finer = coarse_level(level, len(weights))
    index = coarse.long()
    weight = torch.lerp(weights[index], weights[(index + 1).clamp_max(len(weights) - 1)], finer)[:, None]
    slope = z * omega_o[:, :2] / omega_o[:, 2:]
    moved = u + weight * slope / aspect
    if op.learned is None or not torch.is_grad_enabled():
        return moved
    # Its value is 0; its gradient is that of the intersection by the learned heights.
    along = omega_o[:, :2] / omega_o[:, 2:].clamp_min(LEAST_FACING)
    return moved + weight.detach() * _rise(op.learned, run, u, z, omega_o) * along / aspect


def _rise(learned: str, run: Execution, u: Tensor, z: Tensor, omega_o: Tensor) -> Tensor:
    """Rise (n, 1) of intersections with learned heights by the implicit function theorem."""
    textures, aspect = run.material.texture(learned), _per_width(run, u)
    slope = omega_o[:, :2] / omega_o[:, 2:]
    hit = (u + z * slope / aspect).detach().requires_grad_()
    still = lookup(textures.table.detach(), textures.packing, hit)
    (gradient,) = torch.autograd.grad(still.sum(), hit)
    x = textures(hit.detach())
    # (H1) dz = dh / (1 - ∇h · ω_o,xy / ω_o,z), the denominator bounded from below
    facing = 1.0 - HEIGHT_SCALE * (gradient / aspect * slope).sum(1, keepdim=True)
    return HEIGHT_SCALE * (x - x.detach()) / facing.clamp_min(LEAST_FACING)


@PYTORCH.implements(ops.Shade)
def _shade(
    op: ops.Shade,
    run: Execution,
    hits: Tensor,
    level: Tensor,
    omega_i: Tensor,
    omega_o: Tensor,
    depths: Tensor | None,
) -> Tensor:
    return run.material.known.shading(op, hits, level, omega_i, omega_o, depths)


def _ggx(
    f0: Tensor, alpha2: Tensor, normal: Tensor, light: Tensor, view: Tensor, omega_i: Tensor, omega_o: Tensor
) -> Tensor:
    """BRDF (n, 3) of GGX facets of reflectance F0 (n, 3) and α² (n, 1) (Walter et al. 2007; Schlick 1994).

    Parameters
    ----------
    light, view : (n, 1) cosines of light and view to the normal, greater than 0
    """
    half = torch.nn.functional.normalize(omega_i + omega_o, dim=1)
    cosine = (normal * half).sum(1, keepdim=True).clamp_min(0.0)
    facets = alpha2 / (math.pi * (cosine.square() * (alpha2 - 1.0) + 1.0).square())

    def masking(c: Tensor) -> Tensor:
        return (1.0 + alpha2 * (1.0 / c.square() - 1.0)).sqrt()

    return fresnel(f0, half, omega_o) * facets / (2.0 * (masking(light) + masking(view)) * light * view)


@PYTORCH.implements(ops.FiberFrame)
def _fiber_frame(
    op: ops.FiberFrame, run: Execution, hits: Tensor, level: Tensor, omega_i: Tensor, omega_o: Tensor
) -> Tensor:
    return run.material.known.about_fibers(op, hits, level, omega_i, omega_o)


@PYTORCH.implements(ops.Lobe)
def _lobe(
    op: ops.Lobe,
    run: Execution,
    base_color: Tensor,
    specular: Tensor,
    alpha2: Tensor,
    slopes: Tensor,
    omega_i: Tensor,
    omega_o: Tensor,
    weight: Tensor | None,
) -> Tensor:
    normal = torch.nn.functional.normalize(torch.cat([-slopes, torch.ones_like(slopes[:, :1])], 1), dim=1)
    light = (normal * omega_i).sum(1, keepdim=True)
    view = (normal * omega_o).sum(1, keepdim=True).clamp_min(op.least_view)
    alpha2, f0 = alpha2.clamp_min(op.least_alpha2), specular.expand(-1, 3)
    lobe = _ggx(f0, alpha2, normal, light.clamp_min(op.least_light), view, omega_i, omega_o)
    if weight is not None:
        lobe = weight * lobe
    return light.clamp_min(0.0) / omega_i[:, 2:] * (base_color / math.pi + lobe)


@PYTORCH.implements(ops.HalfVector)
def _half_vector(op: ops.HalfVector, run: Execution, omega_i: Tensor, omega_o: Tensor) -> Tensor:
    return torch.nn.functional.normalize(omega_i + omega_o, dim=1)


@PYTORCH.implements(ops.Rotate)
def _rotate(op: ops.Rotate, run: Execution, axis: Tensor, omega: Tensor) -> Tensor:
    if axis.shape[1] == 2:
        upright = (1.0 - axis.square().sum(1, keepdim=True)).clamp_min(0.0).sqrt()
        axis = torch.cat([axis, upright], 1)
    return rotate_to_z(axis, omega)


def _length(vectors: Tensor) -> Tensor:
    return torch.linalg.vector_norm(vectors, dim=1, keepdim=True)


@PYTORCH.implements(ops.ToFrame)
def _to_frame(op: ops.ToFrame, run: Execution, axes: Tensor, omega: Tensor) -> Tensor:
    x, _, z = torch.eye(3, dtype=axes.dtype, device=axes.device)
    normal, toward = axes[:, :3] + z, axes[:, 3:] + x
    normal = normal / _length(normal).clamp_min(op.shortest)
    tangent = toward - (toward * normal).sum(1, keepdim=True) * normal
    tangent = tangent / torch.maximum(_length(tangent), op.shortest * (1.0 + _length(toward)))
    frame = torch.stack([tangent, torch.linalg.cross(normal, tangent), normal], 1)
    return (frame * omega[:, None]).sum(2)


@PYTORCH.implements(ops.Stereographic)
def _stereographic(op: ops.Stereographic, run: Execution, omega: Tensor) -> Tensor:
    return stereographic(omega)


@PYTORCH.implements(ops.Position)
def _position(op: ops.Position, run: Execution, u: Tensor) -> Tensor:
    return 2.0 * (u - u.floor()) - 1.0


@PYTORCH.implements(ops.Frequencies)
def _frequencies(op: ops.Frequencies, run: Execution, x: Tensor, level: Tensor | None) -> Tensor:
    bands = 2.0 ** torch.arange(op.bands, dtype=x.dtype, device=x.device)
    bands = bands * math.pi if op.pi else bands
    angles = (x[..., None] * bands).flatten(-2)
    sines, cosines = angles.sin(), angles.cos()
    if level is not None or op.attenuated:
        size = torch.ones_like(bands)
        if op.attenuated:
            size = size * bands[0] / bands
        if level is not None:
            # Averages over a Gaussian of the standard deviation of the footprint.
            spread = torch.exp2(-level)[..., None] / _per_width(run, x)
            size = size * (-0.5 * (spread[..., None] * bands).square()).exp()
        size = size.expand(*size.shape[:-2], x.shape[-1], op.bands).flatten(-2)
        sines, cosines = sines * size, cosines * size
    return torch.cat([*([x] if op.raw else []), sines, cosines], -1)


@PYTORCH.implements(ops.Network)
def _network(op: ops.Network, run: Execution, x: Sequence[Tensor]) -> Tensor:
    out: Tensor = run.material.get_submodule(op.weights)(torch.cat([*x], 1))
    return out


@PYTORCH.implements(ops.Inception)
def _inception(
    op: ops.Inception, run: Execution, features: Sequence[Tensor], shared: Sequence[Tensor]
) -> Tensor:
    directions = torch.cat([*shared], 1)
    x = torch.cat([*features], 1)
    size = math.isqrt(len(x) // max(1, len(directions)))
    rows, columns = run.grid or (size, size)
    out: Tensor = run.material.get_submodule(op.weights)(x.view(-1, rows, columns, x.shape[1]), directions)
    return out.flatten(0, 2)


def _bounded(value: Tensor, most: Tensor) -> Tensor:
    """At most `most`. Training lowers what lies beyond, and never raises it: there, the positive part of the
    gradient is left."""
    bounded = torch.minimum(value, most)
    if not value.requires_grad:
        return bounded
    bounded, beyond = bounded.detach() + (value - value.detach()), value.detach() > most
    bounded.register_hook(lambda gradient: gradient.masked_fill(beyond & (gradient < 0), 0.0))
    return bounded


@PYTORCH.implements(ops.Transform)
def _transform(op: ops.Transform, run: Execution, x: Tensor) -> Tensor:
    if op.divisor is not None:
        divisor = run.material.number(op.divisor)
        x = torch.where(divisor > 0, x / torch.where(divisor > 0, divisor, 1.0), 0.0)
    value = FUNCTIONS[op.function][0](x if op.scale == 1.0 else op.scale * x)
    value = value if op.most is None else _bounded(value, run.material.number(op.most))
    return value if op.factor is None else run.material.number(op.factor) * value


@PYTORCH.implements(ops.Matrix)
def _matrix(op: ops.Matrix, run: Execution, x: Tensor) -> Tensor:
    return x @ x.new_tensor(op.rows).T


@PYTORCH.implements(ops.Gate)
def _gate(op: ops.Gate, run: Execution, gate: Tensor, x: Tensor, plus: Tensor | None) -> Tensor:
    share = torch.sigmoid(gate)
    share = op.floor + share if op.scale == 1.0 else op.floor + op.scale * share
    value = share * x
    if op.unit is not None:
        value = torch.where(run.material.number(op.unit) > 0, value, 0.0)
    return value if plus is None else value + plus


@PYTORCH.implements(ops.Standardize)
def _standardize(op: ops.Standardize, run: Execution, x: Tensor, mean: Tensor, deviation: Tensor) -> Tensor:
    return mean + deviation * x


@PYTORCH.implements(ops.DivideByCosine)
def _divide_by_cosine(op: ops.DivideByCosine, run: Execution, x: Tensor, omega: Tensor) -> Tensor:
    return x / omega[:, 2:].clamp_min(op.least)


@PYTORCH.implements(ops.Calibrate)
def _calibrate(op: ops.Calibrate, run: Execution, level: Tensor, omega: Tensor) -> Tensor:
    return interpolate_factors(run.material.number(op.factors)[op.table], level, omega[:, 2])


def interpolate_factors(table: Tensor, level: Tensor, cosine: Tensor) -> Tensor:
    """Calibration factors (n, 3) of a table (levels, knots, 3) at fractional levels (n,) and cosines (n,):
    bilinear between levels and knots, which are equidistant in [0, 1]."""
    last = max(1, table.shape[0] - 1)
    # An image whose rows are levels, in the coordinates of grid_sample: corners at -1 and 1.
    position = torch.stack([2.0 * cosine - 1.0, (2.0 / last) * level - 1.0], -1)
    found = torch.nn.functional.grid_sample(
        table.permute(2, 0, 1)[None], position[None, :, None], padding_mode="border", align_corners=True
    )
    return found[0, :, :, 0].T


@PYTORCH.implements(ops.Product)
def _product(op: ops.Product, run: Execution, x: Sequence[Tensor]) -> Tensor:
    first, *rest = x
    for factor in rest:
        first = first * factor
    return first


def rotate_to_z(axis: Tensor, omega: Tensor) -> Tensor:
    """Directions (n, 3), rotated by the shortest rotation that takes unit vectors (n, 3) with z > 0 to z."""
    tangential = (axis[:, :2] * omega[:, :2]).sum(1, keepdim=True)
    share = omega[:, 2:] + tangential / (1.0 + axis[:, 2:])
    return torch.cat([omega[:, :2] - axis[:, :2] * share, axis[:, 2:] * omega[:, 2:] + tangential], 1)


def stereographic(omega: Tensor) -> Tensor:
    """Directions (n, 3) projected from the nadir: (x, y) / (1 + z)."""
    return omega[..., :2] / (1.0 + omega[..., 2:])
