"""Distillation of a material into its sampler (:mod:`mbtf_fit.ops.sampler`).

For random positions, footprints and views, the network minimizes the second moment of the estimate of
reflected light under a constant sky, over its squared mean,

    E[f² / p] / (I² + δ),    f = M ω_i,z,    I = ∫ f dω_i,

which is its relative variance plus 1. The directions that it is estimated from are those of the cosine and
of the network's own lobe, drawn anew in each round. On queries of their own, the network is then compared
with the cosine.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mbtf_core.data.lattice import sigma_of_level
from mbtf_core.directions import from_projected_disk
from mbtf_fit import ops
from mbtf_fit.material.inference import predict
from mbtf_fit.material.sampler import Sampler
from mbtf_fit.ops.operation import SAMPLER
from mbtf_fit.ops.sampler import LARGEST_LOG, LARGEST_WEIGHT, LEAST_ALPHA, sampler_of
from mbtf_fit.pytorch.material import NeuralMaterial
from mbtf_fit.pytorch.networks import Mlp, initialize_layers
from mbtf_fit.pytorch.values import read_values
from mbtf_fit.threads import one_thread_each

# Most queries of a round, and lights of each; a fit has fewer where it was shorter.
QUERIES, LIGHTS = 1 << 13, 32
# Evaluations, as a share of the training queries of a fit; fewest queries of a round, and those of the
# comparison with the cosine.
SHARE, LEAST = 1 / 8, 512
# Steps of a round of most queries, and fewest: in 18 steps, no lobe becomes as narrow as brushed metal's.
ROUNDS, STEPS, LEAST_STEPS, BATCH = 2, 600, 200, 256
# Largest. At twice this rate from the start, the reflection loses its weight before it finds a highlight.
LEARNING_RATE = 1e-2
# Least relative reduction of the second moment; that of a Lambert material varies by less.
GAIN = 1e-3
# The reflection at the start, which half of the directions are of.
FIRST_ALPHA = 0.4
# Where a query reflects little, its variance counts less: δ, as a share of the mean of I².
DARK = 1e-3

F32 = NDArray[np.float32]


@dataclass(frozen=True)
class LightMixture:
    """(S2) The mixture for each query: lower triangle of L, s0 (queries, 1), and the reflection's weight."""

    l11: Tensor
    l21: Tensor
    l22: Tensor
    x: Tensor
    y: Tensor
    weight: Tensor

    @classmethod
    def of(cls, outputs: Tensor) -> LightMixture:
        """Of outputs (queries, 6)."""
        a, shear, b, x, y, logit = outputs.split(1, 1)
        l11, l22 = (LEAST_ALPHA + v.clamp_max(LARGEST_LOG).exp() for v in (a, b))
        return cls(l11, shear * l22, l22, x, y, LARGEST_WEIGHT * torch.sigmoid(logit))

    def _squared_deviation(self, x: Tensor, y: Tensor) -> Tensor:
        tx = (x - self.x) / self.l11
        return tx.square() + ((y - self.y - self.l21 * tx) / self.l22).square()

    def density(self, light: Tensor, view: Tensor) -> Tensor:
        """(S1) Density (queries, lights) of lights (queries, lights, 3) for views (queries, 1, 3)."""
        half = light + view
        x, y, z = half.unbind(-1)
        square = self._squared_deviation(-x / z, -y / z)
        vx, vy, vz = view.unbind(-1)
        flat = (self.l11 * vx + self.l21 * vy).square() + (self.l22 * vy).square()
        up = vz - self.x * vx - self.y * vy
        length = (flat + up.square()).sqrt()
        total = torch.where(up >= 0, length + up, flat / (length - up).clamp_min(1e-20))
        inside = (1.0 + square) * z.square() / half.square().sum(-1)
        below = 2.0 * math.pi * self.l11 * self.l22 * inside.square() * total
        return torch.lerp(light[..., 2] / math.pi, 1.0 / below.clamp_min(1e-20), self.weight)

    def sample(self, view: Tensor, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """`count` lights of each query, half of them of the cosine, half reflected at all facets; and their
        density, 0 below the plane."""
        u, v = torch.rand((2, len(view), count), generator=generator)
        angle, tail = 2.0 * math.pi * v, (u / (1.0 - u)).sqrt()
        tx, ty = tail * angle.cos(), tail * angle.sin()
        slopes = (self.l11 * tx + self.x, self.l21 * tx + self.l22 * ty + self.y)
        half = nn.functional.normalize(torch.stack([-slopes[0], -slopes[1], torch.ones_like(u)], -1), dim=-1)
        reflected = 2.0 * (half * view).sum(-1, keepdim=True) * half - view
        radius = u.sqrt()
        cosine = torch.stack([radius * angle.cos(), radius * angle.sin(), (1.0 - u).sqrt()], -1)
        light = torch.where((torch.arange(count) % 2 == 0)[:, None], cosine, reflected)
        half = nn.functional.normalize(light + view, dim=-1)
        x, y, z = half.unbind(-1)
        facets = 1.0 / (math.pi * self.l11 * self.l22 * (1.0 + self._squared_deviation(-x / z, -y / z)) ** 2)
        density = 0.5 * light[..., 2] / math.pi + facets / (8.0 * z**3 * (half * view).sum(-1))
        return light, torch.where(light[..., 2] > 0, density, 0.0)


@dataclass(frozen=True)
class Samples:
    """Queries of a round, and lights drawn for them.

    Attributes
    ----------
    inputs : of the network (queries, inputs)
    view, light : directions (queries, 1, 3) and (queries, lights, 3)
    squares : f² / (I² + δ), over the density with which the light was drawn (queries, lights)
    """

    inputs: Tensor
    view: Tensor
    light: Tensor
    squares: Tensor

    def moment(self, outputs: Tensor, rows: Tensor | slice = slice(None)) -> Tensor:
        """Relative second moment, a mean over some queries, for the network's outputs (rows, 6)."""
        density = LightMixture.of(outputs).density(self.light[rows], self.view[rows])
        return (self.squares[rows] / density.clamp_min(1e-12)).mean()


def distill(model: NeuralMaterial, training: int, min_cos: float, seed: int) -> Sampler | None:
    """The sampler of a trained material, after some seconds.

    Parameters
    ----------
    training : queries that the fit was trained with; a short fit has a short distillation
    min_cos : smallest cosine of the directions in the data

    Returns
    -------
    Sampler or None
        None where it is no better than the cosine, of a material that reads a neighborhood, and after a few
        steps.
    """
    count = min(QUERIES, int(SHARE * training) // (ROUNDS * LIGHTS))
    if count < LEAST or model.margin:
        return None
    channels = 0 if model.surface is None else model.surface.maps[0].shape[-1]
    operations = sampler_of(model.stored_operations(), channels)
    last = operations[-1]
    assert isinstance(last, ops.Network)
    random = np.random.Generator(np.random.Philox(key=[0x73616D70, seed]))
    generator = torch.Generator().manual_seed(seed)
    inputs = sampler_inputs(model, operations, *_queries(model, count, min_cos, random))
    mean, deviation = inputs.mean(0), inputs.std(0, correction=0)
    # What is constant but for rounding stays so.
    deviation = torch.where(deviation > 1e-4 * (1.0 + mean.abs()), deviation, 1.0)
    network = _initial(last, inputs.shape[1], generator)

    def draw(count: int) -> Samples:
        queries = _queries(model, count, min_cos, random)
        inputs = (sampler_inputs(model, operations, *queries) - mean) / deviation
        return _draw(model, network, inputs, queries, min_cos, generator)

    for _ in range(ROUNDS):
        samples = draw(count)
        with one_thread_each():
            _train(network, samples, max(LEAST_STEPS, STEPS * count // QUERIES), generator)
    samples = draw(LEAST)
    with torch.no_grad():
        outputs = network(samples.inputs)
        # Without the reflection, the cosine is left.
        cosine = outputs.clone()
        cosine[:, 5] = -math.inf
        if not samples.moment(outputs) < (1.0 - GAIN) * samples.moment(cosine):
            return None
        # The network reads its inputs as they are.
        weight, bias, *_ = network.parameters()
        weight.div_(deviation)
        bias.sub_(weight @ mean)
    return Sampler(operations, {f"{SAMPLER}.{n}": p.detach() for n, p in network.named_parameters()})


def _queries(
    model: NeuralMaterial, count: int, min_cos: float, random: np.random.Generator
) -> tuple[F32, F32, F32]:
    """Random (u, sigma, omega_o): levels are uniform, views uniform on the projected disk."""
    angle, radius = 2.0 * np.pi * random.random(count), np.sqrt((1.0 - min_cos**2) * random.random(count))
    views = from_projected_disk(np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1))
    sigma = sigma_of_level(model.lattice.finest * random.random(count))
    u = random.random((count, 2))
    return u.astype(np.float32), sigma.astype(np.float32), views.astype(np.float32)


def sampler_inputs(model: NeuralMaterial, operations: list[ops.Operation], *queries: F32) -> Tensor:
    """Inputs (queries, inputs) of the network."""
    *before, network = operations
    assert isinstance(network, ops.Network)
    device = next(model.parameters()).device
    with torch.no_grad():
        first = model.stage1(*(torch.from_numpy(a).to(device) for a in queries))
        return read_values(model.execute(before, first), network.x).cpu()


def _initial(operation: ops.Network, inputs: int, generator: torch.Generator) -> Mlp:
    """The network before training, whose mixture is the same for all inputs."""
    network = Mlp(operation.widths(inputs), operation.activation)
    initialize_layers(network, generator)
    *_, weight, bias = network.parameters()
    log = math.log(FIRST_ALPHA)
    with torch.no_grad():
        weight.zero_()
        bias.copy_(torch.tensor([log, 0.0, log, 0.0, 0.0, 0.0]))
    return network


def _draw(
    model: NeuralMaterial,
    network: Mlp,
    inputs: Tensor,
    queries: tuple[F32, F32, F32],
    min_cos: float,
    generator: torch.Generator,
) -> Samples:
    view = torch.from_numpy(queries[2])[:, None]
    with torch.no_grad():
        light, density = LightMixture.of(network(inputs)).sample(view, LIGHTS, generator)
    above = density > 0
    light = torch.where(above[..., None], light, torch.tensor([0.0, 0.0, 1.0]))
    each = [np.repeat(a, LIGHTS, 0) for a in queries]
    values = predict(model, each[0], each[1], _raised(light, min_cos), each[2]).mean(1)
    f = torch.where(above, torch.from_numpy(values).view(density.shape) * light[..., 2], 0.0)
    density = torch.where(above, density, 1.0)
    mean2 = (f / density).mean(1, keepdim=True).square()
    # A black material has no moments at all.
    scale = (mean2 + DARK * mean2.mean()).clamp_min(1e-30)
    return Samples(inputs, view, light, f.square() / density / scale)


def _raised(light: Tensor, min_cos: float) -> F32:
    """Lights (n, 3), raised to the lowest ones with data, as the plugin does."""
    flat = nn.functional.normalize(light[..., :2], dim=-1) * math.sqrt(1.0 - min_cos**2)
    lowest = torch.cat([flat, torch.full_like(light[..., 2:], min_cos)], -1)
    raised: F32 = torch.where(light[..., 2:] < min_cos, lowest, light).view(-1, 3).numpy()
    return raised


def _train(network: Mlp, samples: Samples, steps: int, generator: torch.Generator) -> None:
    optimizer = torch.optim.Adam(network.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, total_steps=steps)
    for _ in range(steps):
        rows = torch.randint(0, len(samples.inputs), (BATCH,), generator=generator)
        optimizer.zero_grad()
        samples.moment(network(samples.inputs[rows]), rows).backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
