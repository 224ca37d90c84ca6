"""Maps of any material: a metallic-roughness BRDF fitted to the values of each texel.

Models that know no surface still have values. At the texels of a level, with the footprint of that level,
they are evaluated for pairs of light and view, to which :mod:`~mbtf_fit.material.interchange.least_squares`
fits slopes, roughness, metallic and base color. Views are steep, and follow the neural offset to the points
that the normal view sees, so that parallax blurs no map.

All texels share the first pairs, which resolve no narrow lobes. The second ones are around the highlight of
each texel's own normal, and confirm or refute a narrow lobe. Priors are weighted by the residuals: a lobe
that hardly explains more than a rough dielectric is left out.

Values of a material with holes are divided by what the view meets of it.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbtf_core.data.lattice import texel_centers
from mbtf_fit.material.interchange.brdf import Pairs
from mbtf_fit.material.interchange.least_squares import (
    BASE,
    METALLIC,
    ROUGHNESS,
    SLOPES,
    WEAK,
    Problem,
    minimize,
    minimize_best,
    starts,
    with_color,
)
from mbtf_fit.material.interchange.maps import Maps, opacity_of
from mbtf_fit.material.interchange.values import (
    direction_pairs,
    followed,
    highlight_pairs,
    least_cosine,
    one_thread_each,
    steep_views,
    texel_values,
)
from mbtf_fit.material.material import Material

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
# F0 of a dielectric of refractive index 1.5.
GLTF_DIELECTRIC = 0.04
# Views that all texels share, and those of the highlights; lights per view of either, fewer for models that
# read a neighborhood.
_VIEWS, _OWN_VIEWS = 32, 16
_LIGHTS, _FEW_LIGHTS = (6, 4), (3, 2)
# Greatest sine of the views: without a neural offset, as parallax blurs what low views see, and with one.
_SINES = (0.5, 0.7)
# Least roughness that the shared pairs resolve; roughness of a start in search of narrow lobes.
_RESOLVED, _NARROW = 0.35, 0.2
# Weights of the priors of roughness and metallic, in units of the mean square of the residuals.
_SUPPORT = 0.1
# Steps until the better of two starts is chosen, and after that.
_FIRST_STEPS, _STEPS = 6, 20
# Texels that F0 is chosen by. A tile has no gloss if the mean square of its residuals is at most that of a
# glossy tile times a factor, and exceeds it by another factor at a small share of the texels.
_TRIED, _MATTE, _GLOSSY, _SHARE = 256, 1.05, 1.5, 0.02
# Texels whose values are in memory at once, and per block of a thread; least divisor of values.
_CHUNK, _BLOCK, _LEAST_OPACITY = 4096, 512, 0.05


def _first_fit(values: Tensor, pairs: Pairs, dielectric: float) -> tuple[Tensor, Tensor]:
    """Parameters (n, 7) of values (n, 3, k) of shared pairs, and the scale (n, 1)."""
    scale = values.mean((1, 2))[:, None].clamp_min(1e-6)
    problem = Problem.of(values, scale, pairs, dielectric, _RESOLVED)
    tried = starts(problem, values)
    if dielectric == 0:
        return minimize(problem, tried[0], _STEPS), scale
    return minimize(problem, minimize_best(problem, tried, _FIRST_STEPS), _STEPS), scale


def _second_fit(
    values: Tensor, scale: Tensor, pairs: Pairs, dielectric: float, x: Tensor
) -> tuple[Tensor, Tensor]:
    """Parameters (n, 7) of values (n, 3, k) of each texel's own pairs, and their residuals."""
    problem = Problem.of(values, scale, pairs, dielectric, 0.0)

    def supported(at: Tensor) -> Problem:
        weights = WEAK.repeat(len(at), 1)
        weights[:, [ROUGHNESS, METALLIC]] = _SUPPORT * problem.residuals(at)[:, None]
        return replace(problem, weights=weights)

    if dielectric > 0:
        narrow, rough = x.clone(), x.clone()
        narrow[:, ROUGHNESS] = _NARROW
        narrow = with_color(problem, values, narrow)
        better = problem.objective(narrow) < problem.objective(x)
        rough[:, ROUGHNESS], rough[:, METALLIC] = 1.0, 0.0
        tried = [torch.where(better[:, None], narrow, x), with_color(problem, values, rough)]
        x = minimize_best(supported(x), tried, _FIRST_STEPS)
    problem = supported(x)
    x = minimize(problem, x, _STEPS)
    return x, problem.residuals(x)


def _in_blocks(work: Callable[[slice], tuple[Tensor, Tensor]], count: int) -> tuple[Tensor, Tensor]:
    """Results of `work` for some of `count` texels after the other."""
    parts = [slice(start, start + _BLOCK) for start in range(0, count, _BLOCK)]
    with one_thread_each() as threads, ThreadPoolExecutor(threads) as pool:
        first, second = zip(*pool.map(work, parts), strict=True)
    return torch.cat(first), torch.cat(second)


@dataclass(frozen=True)
class LobeFitter:
    """Fits the texels of a level of a material.

    Attributes
    ----------
    material : Material
    level : int
    """

    material: Material
    level: int

    def _solid(self, u: F64, omega_i: F64, omega_o: F64) -> tuple[Tensor, F32]:
        """Values (n, 3, k) of what the views meet, and the most (n,) that one meets."""
        values, opacity = texel_values(self.material, self.level, u, omega_i, omega_o)
        covered = values / np.maximum(opacity, _LEAST_OPACITY)[..., None]
        return torch.from_numpy(covered).transpose(1, 2).contiguous(), opacity.max(1)

    def fit(self, u: F64, dielectric: float) -> tuple[F32, F32, F32]:
        """Fit texels.

        Parameters
        ----------
        u : (n, 2) array
            Their centers, uv.
        dielectric : float
            F0; with 0, roughness is 1 and metallic 0.

        Returns
        -------
        parameters : (n, 7) array
            Slopes, roughness, metallic, base color.
        residuals : (n,) array
            Mean squares.
        opacity : (n,) array
            The most that a view meets.
        """
        lights, own = _LIGHTS if self.material.model.positions == 1 else _FEW_LIGHTS
        least = least_cosine(self.material)
        moves = any(op.kind() == "offset" for op in self.material.model.operations)
        views = steep_views(_VIEWS, _SINES[moves])
        at = followed(self.material, u, views)
        omega_i = direction_pairs(_VIEWS * lights, least)[0]
        omega_o = np.tile(views, (lights, 1))
        pairs = Pairs.of(omega_i, omega_o, torch.float32)
        values, met = self._solid(np.tile(at, (1, lights, 1)), omega_i, omega_o)
        x, scale = _in_blocks(lambda part: _first_fit(values[part], pairs, dielectric), len(u))
        near_o = np.tile(views[:_OWN_VIEWS], (own, 1))
        near_i = highlight_pairs(x[:, SLOPES].numpy(), near_o, least)
        near, _ = self._solid(np.tile(at[:, :_OWN_VIEWS], (1, own, 1)), near_i, near_o)
        values = torch.cat([values, near], 2)
        n = len(u)
        light = np.concatenate([np.broadcast_to(omega_i, (n, *omega_i.shape)), near_i], 1)
        view = np.concatenate([omega_o, near_o])

        def second(part: slice) -> tuple[Tensor, Tensor]:
            pairs = Pairs.of(light[part], np.broadcast_to(view, light[part].shape), torch.float32)
            return _second_fit(values[part], scale[part], pairs, dielectric, x[part])

        x, residuals = _in_blocks(second, n)
        return x.numpy(), residuals.numpy(), met

    def choose_dielectric(self, u: F64) -> float:
        """F0 of the tile: 0.04, that of glTF; or 0, if the tile and nearly all its texels agree as well
        without gloss.

        `u` (n, 2) are all texels, of which some are tried.
        """
        some = u[np.unique(np.linspace(0, len(u) - 1, min(len(u), _TRIED)).round().astype(int))]
        residuals = []
        for dielectric in (0.0, GLTF_DIELECTRIC):
            _, squares, met = self.fit(some, dielectric)
            residuals.append(squares[met >= _LEAST_OPACITY])
        matte, glossy = residuals
        few = np.count_nonzero(matte > _GLOSSY * glossy) <= _SHARE * len(matte)
        return 0.0 if few and matte.sum() <= _MATTE * glossy.sum() else GLTF_DIELECTRIC


def fit_lobes(material: Material, level: int, advance: Callable[[int], None] = lambda _: None) -> Maps:
    """Fit maps to the values of a material at the texels of a level.

    Parameters
    ----------
    material : Material
    level : int
    advance : callable
        Called with the number of texels done since the last call.

    Returns
    -------
    Maps
        Without heights. F0 is that of glTF, 0.04; or 0, with roughness 1, if a tile without gloss agrees as
        well.
    """
    rows, columns = material.lattice.shape(level)
    u = texel_centers(rows, columns).reshape(-1, 2)
    fitter = LobeFitter(material, level)
    dielectric = fitter.choose_dielectric(u)
    found, most = [], []
    for start in range(0, len(u), _CHUNK):
        part, _, met = fitter.fit(u[start : start + _CHUNK], dielectric)
        found.append(part)
        most.append(met)
        advance(len(part))
    x, met = np.concatenate(found).astype(np.float64), np.concatenate(most)
    holes = met < _LEAST_OPACITY
    if not holes.all():
        # No view meets anything there: the mean color, so that none bleeds in where maps are interpolated.
        x[holes] = np.concatenate([[0.0, 0.0, 1.0, 0.0], x[~holes, BASE].mean(0)])
    maps = x.reshape(rows, columns, 7)
    return Maps(
        level,
        material.lattice.aspect,
        maps[..., BASE],
        maps[..., SLOPES],
        maps[..., ROUGHNESS],
        maps[..., METALLIC],
        opacity_of(material, level),
        dielectric,
        None,
    )
