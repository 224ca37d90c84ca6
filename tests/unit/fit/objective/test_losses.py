"""Losses: what each weighs, what noise does to its minimum, how far a single value reaches."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import InputError
from mbtf_fit.data.queries import TrainingQueries
from mbtf_fit.objective.losses import FourthRoot, Log, LossCurve, Objective
from mbtf_fit.objective.noise import NoiseModel
from mbtf_fit.sections import TrainingSection

KINDS = ("relative", "squared", "linear", "log", "fourth-root")
SCALE = 0.5
# A term that counts little.
RELATIVE = ({"kind": "relative", "weight": 1e-6},)


def objective(kind: str, variance: float = 0.0, **options: Any) -> Objective:
    """One term, for noise of a variance that is the same for all values."""
    training = TrainingSection.model_validate({"losses": [{"kind": kind}], **options})
    c = np.array([variance / SCALE**2, 0, 0])
    return Objective(training, NoiseModel(SCALE, c, np.tile(c, (4, 1)), np.ones(4), 0.0))


def queries(value: Tensor) -> TrainingQueries:
    n = len(value)
    up = torch.tensor([0.0, 0.0, 1.0]).expand(n, 3)
    return TrainingQueries(torch.zeros(n, 2), torch.full((n,), 0.1), up, up, value)


def patches(value: Tensor) -> TrainingQueries:
    """Values (items, rows, columns, 3) with the footprint, light and view of each item."""
    return replace(queries(value[:, 0, 0]), value=value)


def minimum(loss: Objective, value: Tensor) -> float:
    """Prediction at which the mean gradient over values (n, 1) vanishes, by bisection."""
    low, high = 0.2, 2.0
    for _ in range(24):
        middle = (low + high) / 2
        p = torch.full_like(value, middle, requires_grad=True)
        (gradient,) = torch.autograd.grad(loss(p, queries(value)), p)
        low, high = (low, middle) if float(gradient.sum()) > 0 else (middle, high)
    return low


def skewed(relative: float) -> Tensor:
    """Values of mean 1 with gamma noise of a relative deviation, as paths make it: never negative, skewed."""
    random = np.random.default_rng(1)
    shape = 1 / relative**2
    value = random.gamma(shape, 1 / shape, (20_000, 1))
    return torch.from_numpy(value / value.mean())


@pytest.mark.parametrize("kind", KINDS)
def test_by_default_the_minimum_is_the_expectation_whatever_the_noise(kind: str) -> None:
    value = skewed(0.8)
    assert minimum(objective(kind, 0.64, huber_delta=None), value) == pytest.approx(1.0, abs=2e-3)


def test_the_loss_of_color_has_its_minimum_at_the_expectation_and_takes_patches() -> None:
    """Brightness is free; noise that differs between channels, and skewed."""
    mean = torch.tensor([1.0, 0.5, 2.0])
    value = mean * torch.cat([skewed(0.8), skewed(0.4).flip(0), skewed(1.2).roll(7, 0)], 1)
    loss, slopes = objective("chroma", huber_delta=None, losses=[{"kind": "chroma"}, *RELATIVE]), []
    for factor in (torch.ones(3), torch.tensor([1.01, 1.0, 1.0])):
        p = (factor * mean).expand(value.shape).clone().requires_grad_()
        (gradient,) = torch.autograd.grad(loss(p, queries(value)), p)
        slopes.append(gradient.sum(0))
    assert slopes[0].abs().max() < 0.01 * slopes[1].abs().max()
    rows, p = value[:60].view(5, 3, 4, 3), mean * torch.linspace(0.5, 2, 60)[:, None]
    torch.testing.assert_close(loss(p.view(5, 3, 4, 3), patches(rows)), loss(p, queries(value[:60])))


@pytest.mark.parametrize(("kind", "least"), [("linear", 0.15), ("log", 0.08), ("fourth-root", 0.15)])
def test_without_correction_curved_losses_are_biased(kind: str, least: float) -> None:
    """They are dark, by a median or by ½ f''·variance/f': the correction has something to correct."""
    assert minimum(objective(kind, correction="none", huber_delta=None), skewed(0.8)) < 1 - least


def test_the_default_huber_threshold_causes_little_bias() -> None:
    """Ten times noise and scale: of skewed noise as large as the value, three in a million are beyond."""
    assert minimum(objective("relative", 1.0), skewed(1.0)) == pytest.approx(1.0, abs=1e-3)


def test_an_outlier_has_the_gradient_of_the_bound() -> None:
    loss = objective("squared", 0.04)
    gradients = []
    bound = 10 * (SCALE**2 + 0.04) ** 0.5
    for off in (0.5 * bound, bound, 2 * bound, 1e5):
        p = torch.full((1, 3), 1.0, dtype=torch.float64, requires_grad=True)
        value = torch.full((1, 3), 1.0 + off, dtype=torch.float64)
        (gradient,) = torch.autograd.grad(loss(p, queries(value)), p)
        gradients.append(float(gradient[0, 0]))
    assert gradients[0] == pytest.approx(gradients[1] / 2)
    assert gradients[1] == pytest.approx(gradients[2]) == pytest.approx(gradients[3])


@pytest.mark.parametrize("curve", [Log(), FourthRoot()], ids=["log", "fourth-root"])
def test_slopes_are_derivatives(curve: LossCurve) -> None:
    x = torch.tensor([-3.0, -0.6, -0.2, 0.0003, 0.1, 1.0, 30.0], dtype=torch.float64, requires_grad=True)
    value = curve.value(x)
    (slope,) = torch.autograd.grad(value.sum(), x)
    torch.testing.assert_close(slope, curve.slope(x.detach()))


def test_corrected_absolute_terms_are_parabolas_of_the_noise() -> None:
    """e²/2√(v + 0.01), e and v in units of the scale; of neighbors' differences v is that of both."""
    e, v = 0.3 / SCALE, 0.04 / SCALE**2
    loss = objective("linear", 0.04, huber_delta=None)
    found = loss(torch.full((5, 3), 1.0), queries(torch.full((5, 3), 1.3)))
    assert float(found) == pytest.approx(e**2 / 2 / (v + 0.01) ** 0.5, rel=1e-5)
    loss = objective("gradient", 0.04, huber_delta=None)
    value = torch.ones(1, 4, 4, 3, dtype=torch.float64)
    value[:, ::2] += 1e-3
    slope = float(FourthRoot().slope(torch.tensor(1.0 / SCALE, dtype=torch.float64)))
    edge, noise = slope * 1e-3 / SCALE, 2 * slope**2 * v
    # All differences down the columns, none along the rows.
    expected = edge**2 / 2 / (noise + 0.01) ** 0.5 / 2
    assert float(loss(torch.ones_like(value), patches(value))) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("shape", [(2, 1, 6, 3), (2, 6, 1, 3), (2, 1, 1, 3)])
def test_a_single_row_has_gradients_along_it_alone(shape: tuple[int, ...]) -> None:
    value = torch.rand(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    data = patches(value)
    for correction in ("none", "linear"):
        p = torch.zeros_like(value, requires_grad=True)
        loss = objective("gradient", 0.01, correction=correction)(p, data)
        (gradient,) = torch.autograd.grad(loss, p)
        assert bool(loss.isfinite())
        assert bool(gradient.isfinite().all())
        assert bool(loss > 0) == (max(shape[1:3]) > 1)


def test_the_gradient_term_depends_on_differences_of_neighbors_alone() -> None:
    """A constant error costs nothing; an edge costs what it is high."""
    value = torch.zeros(1, 4, 6, 3, dtype=torch.float64)
    data = patches(value)
    loss = objective("gradient", correction="none")
    assert float(loss(value + 0.1, data)) == pytest.approx(0.0, abs=1e-12)
    edge = value.clone()
    edge[:, :, 3:] = 0.1
    height = float(FourthRoot().value(torch.tensor(0.2)) - FourthRoot().value(torch.tensor(0.0)))
    # Five differences along each row, one of them the edge; half the weight is that of columns.
    assert float(loss(edge, data)) == pytest.approx(height / 5 / 2)
    assert float(objective("gradient", 0.01)(edge, data)) > 0


def test_a_term_counts_from_its_start_on() -> None:
    terms = [{"kind": "fourth-root"}, {"kind": "gradient", "weight": 3.0, "start": 0.25}]
    both = Objective(TrainingSection.model_validate({"losses": terms}), NoiseModel.silent(SCALE, Lattice(3)))
    first = objective("fourth-root")
    value, p = torch.rand(2, 5, 5, 3), torch.rand(2, 5, 5, 3)
    whole = both(p, patches(value))
    both.fraction = 0.2
    torch.testing.assert_close(both(p, patches(value)), first(p, patches(value)))
    both.fraction = 0.25
    torch.testing.assert_close(both(p, patches(value)), whole)
    assert float(whole) > float(first(p, patches(value))) + 0.1
    # A quadratic start is one for the kernel.
    terms = [{"kind": "relative"}, {"kind": "log", "start": 0.5}]
    mixed = Objective(TrainingSection.model_validate({"losses": terms}), NoiseModel.silent(SCALE, Lattice(3)))
    assert mixed.quadratic() is None
    mixed.fraction = 0.4
    assert mixed.quadratic() is not None
    with pytest.raises(InputError, match="counts from the start"):
        TrainingSection.model_validate({"losses": terms[1:]})
