"""The marginal cost of a fit follows from its validations."""

from __future__ import annotations

import math
from typing import Any

import pytest

from mbtf_fit.training.validation import MarginalCost, marginal_cost_of


def history(power: float, error: float = 1e-4, total: float = 80.0) -> list[dict[str, Any]]:
    """Validations of an error that falls with a power of time."""
    fractions = (0.1, 0.2, 0.31, 0.49, 0.7, 1.0)
    times = [{"fraction": fraction, "seconds": fraction * total} for fraction in fractions]
    return [t | {"unexplained": 0.2 * t["fraction"] ** -power, "unexplained_error": error} for t in times]


def errors(held_out: float, training: float, error: float = 0.002) -> dict[str, Any]:
    return {
        "held_out_queries": {"mse": {"value": held_out, "error": error}},
        "training": {"mse": {"value": training, "error": error}},
    }


def cost(records: list[dict[str, Any]], *arguments: Any, **options: Any) -> MarginalCost:
    found = marginal_cost_of(records, *arguments, **options)
    assert found is not None
    return found


@pytest.mark.parametrize("power", [0.25, 0.5, 1.0])
def test_halving_follows_the_power_law(power: float) -> None:
    found = cost(history(power), {})
    assert found.describe().startswith("halving the error takes about ")
    assert "0." not in found.describe()
    assert found.halving == pytest.approx(80.0 * (2 ** (1 / power) - 1), rel=1e-6)


def test_only_a_flat_curve_says_that_longer_training_is_useless() -> None:
    found = cost(history(0.02), {})
    assert found.halving == math.inf
    assert found.as_dict()["halving"] is None
    assert "would hardly reduce the error" in found.describe()
    assert cost(history(-0.2), {}).halving == math.inf
    # Too noisy to see a difference: neither sentence is known to be true.
    assert marginal_cost_of(history(0.25, error=0.03), {}) is None
    assert marginal_cost_of(history(0.02, error=0.03), {}) is None
    # Hardly falling at all: more years than anyone has, or than a number holds.
    assert cost(history(1e-4, error=1e-9), {}).halving == math.inf


def test_few_steps_ask_for_more_whatever_the_curve_shows() -> None:
    for power in (0.0, 0.5):
        records = [r | {"step": round(146 * r["fraction"])} for r in history(power)]
        found = cost(records, errors(0.25, 0.15), 0.3)
        assert found.describe().startswith("146 steps are few: train longer")
        assert found.noise_share is None
    assert cost([r | {"step": 2000} for r in history(0.5)], {}).steps is None


def test_half_of_the_distance_to_the_training_error_is_overfitting() -> None:
    # Least squares with k free numbers and noise s² in n queries misses others by s²k/n, and seems to miss
    # its own by -s²k/n.
    found = cost(history(0.5), errors(0.2 + 0.05, 0.2 - 0.05), 0.3)
    assert found.noise_share == pytest.approx(0.05 / 0.25)
    assert "overfitting to noise causes 20% of the error" in found.describe()
    for same in (errors(0.25, 0.248), errors(0.25, 0.3), {}, errors(math.nan, 0.1)):
        assert cost(history(0.5), same, 0.3).noise_share is None


@pytest.mark.parametrize(
    ("noise", "share"), [(None, None), (0.0, None), (0.03, 0.12), (0.05, 0.2), (1.0, 0.2)]
)
def test_overfitting_is_bounded_by_the_noise(noise: float | None, share: float | None) -> None:
    """Few queries without noise leave the same distance: what lies between them was not learned."""
    found = cost(history(0.5), errors(0.25, 0.15), noise).noise_share
    assert found == (share if share is None else pytest.approx(share))


def test_incomplete_histories_give_no_marginal_cost() -> None:
    unknown = [{**r, "unexplained": None, "unexplained_error": None} for r in history(0.5)]
    for records in ([], history(0.5)[:-1], history(0.5)[-1:], unknown):
        assert marginal_cost_of(records, {}) is None
