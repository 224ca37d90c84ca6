"""Losses are unbiased by noise, and weigh as they say."""

from __future__ import annotations

import pytest
import torch

from mbtf_fit.losses import relative_error, squared_error


@pytest.mark.parametrize("loss", [squared_error(0.5), relative_error(0.3)], ids=["squared", "relative"])
def test_minimum_is_the_expectation_of_skewed_noise(loss) -> None:  # type: ignore[no-untyped-def]
    generator = torch.Generator().manual_seed(1)
    value = torch.empty(200_000).exponential_(generator=generator)  # mean 1, median 0.69
    p = torch.tensor(0.2, requires_grad=True)
    optimiser = torch.optim.SGD([p], lr=0.3)
    for _ in range(300):
        optimiser.zero_grad()
        loss(p, value).backward()
        optimiser.step()
    assert float(p.detach()) == pytest.approx(float(value.mean()), rel=1e-3)


def test_squared_is_in_units_of_the_variance() -> None:
    value = torch.tensor([1.0, 3.0])
    assert float(squared_error(1.0)(torch.tensor([2.0, 2.0]), value)) == pytest.approx(1.0)


def test_relative_weighs_by_the_prediction_alone() -> None:
    loss = relative_error(0.5)
    p = torch.tensor([2.0], requires_grad=True)
    value = torch.tensor([3.0])
    out = loss(p, value)
    assert float(out) == pytest.approx(1.0 / 4.25)
    out.backward()
    # The weight is a constant under differentiation.
    assert p.grad is not None
    assert float(p.grad) == pytest.approx(2 * (2.0 - 3.0) / 4.25)


def test_dark_values_count_absolutely() -> None:
    loss = relative_error(1.0)
    dark, bright = torch.tensor([0.01]), torch.tensor([100.0])
    assert float(loss(dark, dark + 0.1)) == pytest.approx(0.01, rel=1e-3)
    assert float(loss(bright, bright * 1.1)) == pytest.approx(0.01, rel=1e-3)
