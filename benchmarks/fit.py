"""Speed of the fitter: training and inference beside plain PyTorch, and what each model costs to evaluate.

    python benchmarks/fit.py [speed] [--finest 8] [--batch 65536] [--rounds 3]
    python benchmarks/fit.py models [--resolution 64] [--rounds 12]

``speed``: ``neumip`` with a pyramid of 256² and batches of 2^16, in three ways that take turns:

- **plain**: as one writes it down (class ``Plain``): one tensor per level, blurred by FFT while the blur is
  annealed, ``grid_sample``, ``torch.nn.Linear``, autograd, Adam;
- **pytorch**: the fitter without the compiled kernel;
- **kernel**: the compiled kernel, where it is there.

A round takes one step of each way at ten moments of the annealing, so that its mean is that of a whole
training. First the three are checked to evaluate the same model alike.

``models``: processor time of both stages per value on one thread, models with random weights.

The last line is one JSON object. Thresholds of the speed hold on two cores with the kernel.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections import defaultdict
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from common import finish, parser_of, start, timed
from front import NEUMIP
from torch import Tensor, nn

from mbtf_core.data.lattice import Lattice, sigma_of_level
from mbtf_core.directions import from_projected_disk
from mbtf_fit.config import FitConfig, ModelName, build_model
from mbtf_fit.data.queries import TrainingQueries
from mbtf_fit.material.inference import predict
from mbtf_fit.native import library
from mbtf_fit.objective.noise import NoiseModel
from mbtf_fit.objective.parallel import MAX_KERNEL_THREADS, MAX_THREADS, Workers
from mbtf_fit.pytorch.material import NeuralMaterial
from mbtf_fit.pytorch.textures import NEGLIGIBLE, annealed_sigma
from mbtf_fit.training.loop import keep_freed_memory
from mbtf_fit.training.trainer import BETAS, Trainer

# Times the plain way's queries per second, on two cores.
THRESHOLDS = {"training": 3.0, "inference": 2.0}
CORES = 2
# Models that need no known surface.
COMPARED: tuple[ModelName, ...] = ("neumip-baseline", "neumip", "hierarchical", "rainer2019", "rainer2020")
# Positions that are evaluated at a time; a model of the presets' size; the most that models may cost.
POSITIONS = 1 << 15
WIDE = "neumip-wide"
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    **{name: (name, {}) for name in COMPARED},
    WIDE: ("neumip", NEUMIP["network"]),
}
OVER_NEUMIP = {WIDE: 2.0}
# Moments of training at which a step is timed, as shares of the budget.
MOMENTS = [0.05 + 0.1 * k for k in range(10)]
STEPS = 10_000


def bilinear(texture: Tensor, u: Tensor) -> Tensor:
    """Lookup in a periodic texture (rows, columns, channels) at u (n, 2). PyTorch's function, faster than
    indexing, does not wrap: one texel more on every side does."""
    rows, columns, channels = texture.shape
    image = nn.functional.pad(texture.permute(2, 0, 1)[None], (1, 1, 1, 1), mode="circular")
    at = u - u.floor()
    x = (2 * at[:, 0] - 1) * columns / (columns + 2)
    y = (1 - 2 * at[:, 1]) * rows / (rows + 2)
    grid = torch.stack([x, y], 1).view(1, 1, -1, 2)
    found = nn.functional.grid_sample(image, grid, mode="bilinear", align_corners=False)
    return found.view(channels, -1).t()


def blur_by_fft(texture: Tensor, sigma: float) -> Tensor:
    """A periodic texture (rows, columns, channels) through a Gaussian of `sigma` texels."""
    rows, columns, _ = texture.shape
    fy, fx = torch.fft.fftfreq(rows)[:, None], torch.fft.rfftfreq(columns)[None, :]
    transfer = torch.exp(-2 * (torch.pi * sigma) ** 2 * (fx**2 + fy**2))
    spectrum = torch.fft.rfft2(texture, dim=(0, 1)) * transfer[..., None]
    return torch.fft.irfft2(spectrum, s=(rows, columns), dim=(0, 1))


def network(inputs: int, outputs: int) -> nn.Sequential:
    """The paper's networks: four layers, 25 features."""
    sizes = [inputs, 25, 25, 25, outputs]
    layers: list[nn.Module] = []
    for a, b in pairwise(sizes):
        layers += [nn.Linear(a, b), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


class Plain(nn.Module):
    """``neumip`` as plain PyTorch."""

    def __init__(self, lattice: Lattice, unit: float) -> None:
        super().__init__()
        self.lattice, self.unit = lattice, unit
        shapes = [lattice.shape(s) for s in range(lattice.finest + 1)]
        self.pyramid = nn.ParameterList(nn.Parameter(torch.empty(*shape, 7)) for shape in shapes)
        self.offset_texture = nn.Parameter(torch.empty(*shapes[-1], 7))
        self.decoder, self.offset_network = network(11, 3), network(9, 1)

    def take(self, model: NeuralMaterial) -> None:
        """Take over the weights of the fitter's model."""
        weights = model.weights()
        with torch.no_grad():
            for s, texture in enumerate(self.pyramid):
                texture.copy_(weights[f"pyramid.{s}"])
            self.offset_texture.copy_(weights["offset_texture.0"])
            for name in ("decoder", "offset_network"):
                for k, layer in enumerate(getattr(self, name)[::2]):
                    layer.weight.copy_(weights[f"{name}.{k}.weight"])
                    layer.bias.copy_(weights[f"{name}.{k}.bias"])

    def forward(self, q: TrainingQueries, sigma: float, offset_sigma: float) -> Tensor:
        """Values (n, 3), textures blurred by `sigma` texels of the finest level."""
        columns = self.lattice.shape()[1]
        pyramid: list[Tensor] = list(self.pyramid)
        for s, texture in enumerate(pyramid):
            local = sigma * texture.shape[1] / columns
            if local >= NEGLIGIBLE:
                pyramid[s] = blur_by_fft(texture, local)
        offset_texture: Tensor = self.offset_texture
        if offset_sigma > 0:
            offset_texture = blur_by_fft(offset_texture, offset_sigma)
        seen = bilinear(offset_texture, q.u)
        r = 0.1 * self.offset_network(torch.cat([seen, q.omega_o[:, :2]], 1))
        step = r * q.omega_o[:, :2] / q.omega_o[:, 2:].clamp_min(0.6)
        u = q.u + step / torch.tensor([1.0, self.lattice.aspect])
        level = (-torch.log2(2 * q.sigma)).clamp(0, self.lattice.finest)
        features = torch.zeros(len(u), 7)
        for s, texture in enumerate(pyramid):
            weight = (1 - (level - s).abs()).clamp_min(0)
            rows = weight.nonzero()[:, 0]
            part = weight[rows, None] * bilinear(texture, u[rows])
            features = features.index_add(0, rows, part)
        x = self.decoder(torch.cat([features, q.omega_i[:, :2], q.omega_o[:, :2]], 1))
        value = self.unit * torch.expm1(x)
        return value


def random_batch(random: np.random.Generator, n: int, lattice: Lattice) -> TrainingQueries:
    """Queries of all levels and directions, of values between 0.1 and 0.3."""
    disk = np.sqrt(0.99 * random.random((2, n, 1)))
    angle = 2 * np.pi * random.random((2, n, 1))
    omega = from_projected_disk(disk * np.concatenate([np.cos(angle), np.sin(angle)], -1))
    sigma = sigma_of_level(lattice.finest * random.random(n))
    arrays = (random.random((n, 2)), sigma, *omega, 0.1 + 0.2 * random.random((n, 3)))
    return TrainingQueries(*(torch.from_numpy(np.ascontiguousarray(a, np.float32)) for a in arrays))


def use_kernel(yes: bool) -> None:
    """Let everything that follows use the kernel, or not."""
    os.environ[library.ENVIRONMENT] = "auto" if yes else "off"
    library.reload()


class Plainly:
    """Trains ``Plain``: one call, one step."""

    def __init__(self, model: Plain, config: FitConfig, unit: float) -> None:
        self.model, self.config, self.unit = model, config, unit
        training = config.training
        texels = [*model.pyramid, model.offset_texture]
        weights = [*model.decoder.parameters(), *model.offset_network.parameters()]
        self.optimizer = torch.optim.Adam(
            [
                {"params": texels, "lr": training.texture_learning_rate},
                {"params": weights, "lr": training.learning_rate},
            ],
            betas=BETAS,
        )

    def __call__(self, batch: TrainingQueries, share: float) -> None:
        blur = self.config.training.blur
        sigma = annealed_sigma(share / blur.fraction, blur.initial_sigma, blur.final_sigma)
        p = self.model(batch, sigma, max(sigma, blur.offset_sigma))
        loss = ((p - batch.value) ** 2 / (p.detach() ** 2 + self.unit**2)).mean()
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()


class Ours:
    """The fitter's trainer, taken to any moment: one call, one step."""

    def __init__(
        self, model: NeuralMaterial, config: FitConfig, queries: TrainingQueries, kernel: bool
    ) -> None:
        use_kernel(kernel)
        unit = float(queries.value.mean())
        self.trainer = Trainer(config, model, queries, NoiseModel.silent(unit, model.lattice))
        self.backend = self.trainer.backend
        self.limit = MAX_KERNEL_THREADS if kernel else MAX_THREADS

    def __call__(self, batch: TrainingQueries, share: float) -> None:
        self.trainer.progress.step = round(share * STEPS)
        self.trainer._step(batch, self.workers)

    def __enter__(self) -> Ours:
        self.workers = Workers(torch.device("cpu"), limit=self.limit)
        self.workers.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self.workers.__exit__(None, None, None)


def measure_speed(arguments: argparse.Namespace) -> int:
    """Training and inference in three ways."""
    lattice, n = Lattice(arguments.finest), arguments.batch
    # The fitter does so for its own path; the plain way has it too.
    keep_freed_memory()
    config = FitConfig.model_validate(
        {"model": "neumip", "training": {"steps": STEPS, "batch": n, "losses": [{"kind": "relative"}]}}
    )
    queries = random_batch(np.random.default_rng(0), n * len(MOMENTS), lattice)
    batches = [queries.slice(k * n, (k + 1) * n) for k in range(len(MOMENTS))]
    unit = float(queries.value.mean())

    def fresh() -> NeuralMaterial:
        model = build_model("neumip", lattice)
        model.initialize(torch.Generator().manual_seed(0), unit)
        return model

    plainly = Plainly(Plain(lattice, unit), config, unit)
    plainly.model.take(fresh())

    pytorch = Ours(fresh(), config, queries, kernel=False)
    kernel = Ours(fresh(), config, queries, kernel=True)
    ours = {"pytorch": pytorch} | ({"kernel": kernel} if kernel.backend != "pytorch" else {})
    checked, model = batches[0].slice(0, 4096), fresh()
    arrays = [a.numpy() for a in (checked.u, checked.sigma, checked.omega_i, checked.omega_o)]
    with torch.no_grad():
        expected = plainly.model(checked, 0.0, 0.0).clamp_min(0).numpy()
    for way in ours:
        use_kernel(way == "kernel")
        if not np.allclose(predict(model, *arrays), expected, atol=1e-4 * unit, rtol=1e-4):
            raise SystemExit(f"{way} and plain evaluate different models: the figures mean nothing")

    training: dict[str, list[float]] = defaultdict(list)
    inference: dict[str, list[float]] = defaultdict(list)
    whole = [a.numpy() for a in (queries.u, queries.sigma, queries.omega_i, queries.omega_o)]

    def plain_inference() -> None:
        with torch.no_grad():
            for batch in batches:
                plainly.model(batch, 0.0, 0.0).clamp_min(0)

    def all_moments(step: Plainly | Ours) -> None:
        for batch, moment in zip(batches, MOMENTS, strict=True):
            step(batch, moment)

    for number in range((arguments.rounds or 3) + 1):
        times = {"plain": timed(partial(all_moments, plainly))}
        for way, mine in ours.items():
            with mine:
                times[way] = timed(partial(all_moments, mine))
        evaluations = {"plain": timed(plain_inference)}
        for way in ours:
            use_kernel(way == "kernel")
            evaluations[way] = timed(lambda: predict(model, *whole))
        if number > 0:  # the first round warms up
            for way in times:
                training[way].append(times[way])
                inference[way].append(evaluations[way])
    rates = {
        kind: {way: len(queries) / statistics.median(found) for way, found in measured.items()}
        for kind, measured in (("training", training), ("inference", inference))
    }
    best = "kernel" if "kernel" in ours else "pytorch"
    ratios = {kind: found[best] / found["plain"] for kind, found in rates.items()}
    print(f"{lattice.shape()[1]}² pyramid, batch {n}, {torch.get_num_threads()} threads, {kernel.backend}")
    for kind, found in rates.items():
        line = "  ".join(
            f"{way} {rate / 1e6:.2f} M queries/s ({rate / found['plain']:.1f}x)"
            for way, rate in found.items()
        )
        print(f"{kind:10s} {line}")
    applies = torch.get_num_threads() == CORES and "kernel" in ours
    met = all(ratios[kind] >= least for kind, least in THRESHOLDS.items()) if applies else None
    figures = {
        "queries_per_second": rates,
        "ratios": ratios,
        "path": kernel.backend,
        "threads": torch.get_num_threads(),
    }
    return finish(figures, THRESHOLDS, met)


def cost(name: str, finest: int, repeat: int) -> dict[str, Any]:
    """Microseconds of processor time per value, and weights."""
    model_name, network = CASES[name]
    lattice = Lattice(finest)
    model = build_model(model_name, lattice, **network)
    model.initialize(torch.Generator().manual_seed(0), 0.1)
    n = POSITIONS // model.positions
    q = random_batch(np.random.default_rng(0), n, lattice)
    first, second = [], []
    with torch.no_grad():
        for _ in range(repeat):
            start = time.process_time()
            features = model.stage1(q.u, q.sigma, q.omega_o)
            middle = time.process_time()
            model.stage2(features, q.omega_i, q.omega_o)
            first.append(middle - start)
            second.append(time.process_time() - middle)
    return {
        "weights": sum(p.numel() for p in model.parameter_groups()[1]),
        "positions": model.positions,
        "stage1_us": min(first) / n * 1e6,
        "stage2_us": min(second) / n * 1e6,
    }


def measure_models(arguments: argparse.Namespace) -> int:
    """Processor time of both stages per value."""
    torch.set_num_threads(1)
    finest = arguments.resolution.bit_length() - 1
    found = {name: cost(name, finest, arguments.rounds or 12) for name in CASES}
    for name, f in found.items():
        print(
            f"{name:16s} {f['weights']:5d} weights   {f['positions']:2d} positions   "
            f"stage 1 {f['stage1_us']:8.2f} us   stage 2 {f['stage2_us']:8.2f} us"
        )
    total = {name: f["stage1_us"] + f["stage2_us"] for name, f in found.items()}
    ratios = {name: total[name] / total["neumip"] for name in total}
    met = all(ratios[name] <= most for name, most in OVER_NEUMIP.items())
    return finish({"models": found, "over_neumip": ratios}, OVER_NEUMIP, met)


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("part", nargs="?", choices=("speed", "models"), default="speed")
    parser.add_argument("--finest", type=int, default=8, help="finest level: 2^k texels across")
    parser.add_argument("--batch", type=int, default=1 << 16, help="queries per step")
    parser.add_argument("--resolution", type=int, default=64, help="texels across, of the models")
    parser.add_argument("--rounds", type=int, help="timed rounds: 3, of models 12")
    arguments = parser.parse_args()
    return measure_speed(arguments) if arguments.part == "speed" else measure_models(arguments)


if __name__ == "__main__":
    start(main)
