"""What a fit says of longer training and more data follows from its validations."""

from __future__ import annotations

import math
from typing import Any

import pytest

from mbtf_fit.training.validation import MarginalCost, marginal_cost_of


def history(power: float, error: float = 1e-4, steps: int = 4000) -> list[dict[str, Any]]:
    """Validations of an error that falls with a power of time, and its relative standard error."""
    records = [
        {"fraction": fraction, "step": round(fraction * steps)} for fraction in (0.1, 0.31, 0.5, 0.7, 1.0)
    ]
    values = [0.2 * r["fraction"] ** -power for r in records]
    return [
        r | {"unexplained": v, "unexplained_error": error * v} for r, v in zip(records, values, strict=True)
    ]


def errors(held_out: float, training: float, error: float = 0.002) -> dict[str, Any]:
    return {
        "held_out_queries": {"mse": {"value": held_out, "error": error}},
        "training": {"mse": {"value": training, "error": error}},
    }


def cost(records: list[dict[str, Any]], *arguments: Any, **options: Any) -> MarginalCost:
    found = marginal_cost_of(records, *arguments, **options)
    assert found is not None
    return found


@pytest.mark.parametrize("power", [0.2, 0.4, 0.8])
def test_twice_the_time_gains_half_of_what_the_second_half_did(power: float) -> None:
    """A slope that is known well outweighs what the number of steps suggests."""
    found = cost(history(power), {})
    assert found.doubling == pytest.approx(2 ** (-power / 2), rel=0.2 * power)
    assert (
        found.describe() == f"expect about {found.doubling:.2g} of this error after twice the training time"
    )
    # Of an uncertain slope, less weight is left; of one that is hardly known, none.
    uncertain = cost(history(power, error=0.12), {})
    assert found.doubling is not None
    assert uncertain.doubling is not None
    assert math.log(uncertain.doubling) > 0.7 * math.log(found.doubling)
    assert cost(history(power, error=0.2), {}).doubling is None


def test_the_middle_record_counts_by_its_fraction() -> None:
    records = history(0.3)
    later = [r for r in records if r["fraction"] != 0.5]
    later.insert(2, history(0.3)[0] | {"fraction": 0.62, "unexplained": 0.2 * 0.62**-0.3})
    assert cost(later, {}).doubling == pytest.approx(cost(records, {}).doubling, rel=0.02)


def test_only_a_flat_curve_says_that_longer_training_is_useless() -> None:
    useless = "longer training alone would hardly reduce the error"
    assert cost(history(0.02), {}).describe() == useless
    assert cost(history(-0.2), {}).describe() == useless
    assert useless not in cost(history(0.25), {}).describe()
    # An error as uncertain as that of a glossy metal tells neither.
    for records in (history(0.02, error=0.4), history(0.25, error=0.4)):
        assert cost(records, {}).doubling is None
        assert "too uncertain to say what longer training would gain" in cost(records, {}).describe()


def test_few_steps_ask_for_more_whatever_the_curve_shows() -> None:
    for power in (0.0, 0.5):
        found = cost(history(power, steps=146), {})
        assert found.describe().startswith("146 steps are few: train longer (--time); expect about 0.")
    assert (
        cost(history(0.0, error=0.4, steps=146), {}).describe() == "146 steps are few: train longer (--time)"
    )
    # Without a record in the middle, the number of steps decides: the error is about 1 + 50 / N.
    for steps, expected in ((50, 0.75), (150, 0.875)):
        found = cost(history(0.5, steps=steps)[-1:], {})
        assert found.doubling == pytest.approx(expected, abs=1e-3)


def test_half_of_the_distance_to_the_training_error_is_overfitting() -> None:
    # Least squares with k free numbers and noise s² in n queries misses others by s²k/n, and seems to miss
    # its own by -s²k/n.
    found = cost(history(0.5), errors(0.2 + 0.05, 0.2 - 0.05), 0.3)
    assert found.noise_share == pytest.approx(0.05 / 0.25)
    # Twice the queries halve this part. Two standard errors of 0.002, over 2 x 0.25: ± 0.01.
    assert "causes 19% to 21% of the error of new queries: expect 0.9 to 0.9 of it" in found.describe()
    for same in (errors(0.25, 0.248), errors(0.25, 0.3), {}, errors(math.nan, 0.1)):
        assert cost(history(0.5), same, 0.3).noise_share is None


@pytest.mark.parametrize(
    ("noise", "share"), [(None, None), (0.0, None), (0.03, 0.12), (0.05, 0.2), (1.0, 0.2)]
)
def test_overfitting_is_bounded_by_the_noise(noise: float | None, share: float | None) -> None:
    """Few queries without noise leave the same distance: what lies between them was not learned."""
    found = cost(history(0.5), errors(0.25, 0.15), noise).noise_share
    assert found == (share if share is None else pytest.approx(share))


def test_incomplete_histories_say_nothing() -> None:
    for records in ([], history(0.5)[:-1]):
        assert marginal_cost_of(records, {}) is None
    unknown = [{**r, "unexplained": None, "unexplained_error": None} for r in history(0.5)]
    assert cost(unknown, {}).as_dict() == {
        "doubling": None,
        "noise_share": None,
        "steps": 4000,
        "noise_share_error": 0.0,
    }
