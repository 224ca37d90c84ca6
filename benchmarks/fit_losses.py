"""Bias that noise leaves in each loss, without and with correction.

    python benchmarks/fit_losses.py [--material FOLDER --shards FOLDER]

One true value, many noisy ones around it: gamma noise, never negative and skewed as that of light paths, of
a relative deviation of 0.3, 0.8 and 1.5 (a query of many, of some and of few paths). The prediction that
minimizes the mean loss is what training tends to; its distance from the true value is the bias. The variance
model knows the noise, the robust rule is at its default. The rows "weighed by ..." show what weights from a
query's own noisy value would do.

With a material and the data it was fitted to: how noisy these are, which share of the values lies beyond the
robust bound, and by how much the bound darkens the mean, with the material's predictions as true values.

The last line is one JSON object: figures, and the bar they are held to. Exit code 1 where it is missed.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mbtf_fit.data.queries import TrainingQueries
from mbtf_fit.objective.losses import Objective
from mbtf_fit.objective.noise import NoiseModel
from mbtf_fit.sections import TrainingSection

KINDS = ("relative", "squared", "linear", "log", "fourth-root")
CORRECTIONS = ("none", "second-order", "linear")
NOISE = (0.3, 0.8, 1.5)
# The default correction's bias, by magnitude.
BAR = 0.005
COUNT = 10_000

# (prediction, both halves) → mean loss.
Loss = Callable[[Tensor, Tensor, Tensor], Tensor]


def halves(relative: float) -> tuple[Tensor, Tensor]:
    """Two halves (n, 1) of values around 1 whose mean has the given relative deviation."""
    random = np.random.default_rng(0)
    shape = 1 / (2 * relative**2)
    a, b = random.gamma(shape, 1 / shape, (2, COUNT, 1))
    scale = 2 / (a.mean() + b.mean())
    return torch.from_numpy(a * scale), torch.from_numpy(b * scale)


def minimum(loss: Loss, a: Tensor, b: Tensor) -> float:
    """Prediction at which the mean gradient changes its sign."""
    low, high = 0.05, 4.0
    for _ in range(14):
        middle = (low + high) / 2
        p = torch.full_like(a, middle, requires_grad=True)
        (gradient,) = torch.autograd.grad(loss(p, a, b), p)
        low, high = (low, middle) if float(gradient.sum()) > 0 else (middle, high)
    return (low + high) / 2


def objective(kind: str, correction: str, relative: float) -> Loss:
    """A loss of the fitter, on the mean of the halves."""
    training = TrainingSection.model_validate({"losses": [{"kind": kind}], "correction": correction})
    c = np.array([0.0, 0.0, relative**2])
    found = Objective(training, NoiseModel(1.0, c, c[None], np.ones(4), 0.0))
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(COUNT, 3)

    def loss(p: Tensor, a: Tensor, b: Tensor) -> Tensor:
        value = (a + b) / 2
        return found(p, TrainingQueries(value, torch.full((COUNT,), 0.5).double(), up, up, value))

    return loss


def by_value(p: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Relative error whose weight is made of the noisy value."""
    t = (a + b) / 2
    return ((p - t).square() / (t.square() + 1)).mean()


def by_halves(p: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Squared error weighed by the noise that a query's own halves show."""
    return ((p - (a + b) / 2).square() / ((a - b).square() / 4 + 0.1)).mean()


def real_noise(material: Path, shards: Path) -> dict[str, float]:
    """Relative noise, share of values beyond the bound, relative bias of their mean: 65 536 queries."""
    from mbtf_fit import Material
    from mbtf_fit.data.loader import load_training
    from mbtf_fit.data.queries import mean_value
    from mbtf_fit.objective.noise import typical_value
    from mbtf_gen.dataset.reader import Dataset

    loaded, data = Material.load(material), Dataset.open(shards)
    # Half a gigabyte at most: what is trained on stays on disk.
    sample = load_training(data, loaded.config.held_out, loaded.config.seed, memory=5e8).sample
    value, p = mean_value(sample.value_a, sample.value_b), loaded.predict(sample)
    noise = NoiseModel.of(sample, data.lattice, typical_value(value))
    bound = (loaded.config.training.huber_delta or np.inf) * noise.spread(torch.from_numpy(p)).numpy()
    error = value - p
    return {
        "relative_noise": float(np.sqrt(((sample.value_a - sample.value_b) ** 2 / 4).mean()) / value.mean()),
        "beyond": float((np.abs(error) > bound).mean()),
        "bias": float((np.clip(error, -bound, bound) - error).mean() / value.mean()),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--material", type=Path, help="folder made by mbtf-fit")
    parser.add_argument("--shards", type=Path, help="the data that it was fitted to")
    arguments = parser.parse_args()
    # Arrays this small gain nothing from a second thread.
    torch.set_num_threads(1)
    pairs = {relative: halves(relative) for relative in NOISE}
    bias: dict[str, list[float]] = {}
    for kind in KINDS:
        for correction in CORRECTIONS:
            losses = [objective(kind, correction, relative) for relative in NOISE]
            found = [minimum(f, *pairs[r]) - 1 for f, r in zip(losses, NOISE, strict=True)]
            bias[f"{kind}, {correction}"] = found
    for name, loss in (("weighed by the value", by_value), ("weighed by the halves", by_halves)):
        bias[name] = [minimum(loss, *pairs[r]) - 1 for r in NOISE]
    print(f"{'loss, correction':28s}" + "".join(f"noise {r:<8g}" for r in NOISE))
    for name, found in bias.items():
        print(f"{name:28s}" + "".join(f"{x:+8.1%}      " for x in found))
    worst = max(abs(x) for name, found in bias.items() if name.endswith(", linear") for x in found)
    real = None
    if arguments.material and arguments.shards:
        real = real_noise(arguments.material, arguments.shards)
        print(
            f"{arguments.shards}: noise of a query {real['relative_noise']:.0%} of the mean; "
            f"{real['beyond']:.1e} of the values lie beyond the bound, which moves the mean by "
            f"{real['bias']:+.1e}"
        )
    print(
        json.dumps({"bias": bias, "real": real, "worst_of_default": worst, "bar": BAR, "met": worst <= BAR})
    )
    return 0 if worst <= BAR else 1


if __name__ == "__main__":
    sys.exit(main())
