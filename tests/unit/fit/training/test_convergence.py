"""What a fit says of longer training and more data follows from its validations."""

from __future__ import annotations

import math
from typing import Any

import pytest

from mbtf_fit.training.next_step import next_step
from mbtf_fit.training.validation import FLAT, MarginalCost, caveat, marginal_cost_of


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


def fitted(value: float, error: float, training: float = 0.1) -> dict[str, Any]:
    """Errors of a fit, of the test split and of training queries."""
    both = {"test": (value, error), "training": (training, 0.001)}
    return {name: {"n": 8192, "unexplained": {"value": v, "error": e}} for name, (v, e) in both.items()}


def cost(records: list[dict[str, Any]], errors: dict[str, Any], **training: Any) -> MarginalCost:
    found = marginal_cost_of(records, errors, training)
    assert found is not None
    return found


def test_fits_of_few_steps_or_large_errors_do_not_rank_models() -> None:
    assert caveat([], {"steps": 400}, {"value": 0.99, "error": 0.0}) == ""
    assert "not converged" in caveat([], {"steps": 399}, {"value": None, "error": None})
    assert "worse than the mean value" in caveat([], {"steps": 400}, {"value": 1.5, "error": 0.0})
    # Where the error may as well lie below 1, nothing is said.
    assert caveat([], {"steps": 400}, {"value": 1.5, "error": 0.3}) == ""


@pytest.mark.parametrize(
    ("steps", "power", "error", "marked"),
    [
        # From 3.27 half-way to 0.466: twice the time left 0.75 of it.
        (473, 2.8, 1e-3, True),
        (473, 0.05, 1e-3, False),
        (365, 0.05, 1e-3, False),
        (4000, 1.0, 1e-3, True),
        # The curve is not resolved, or hardly begun.
        (365, 0.05, 0.4, True),
        (473, 2.8, 0.4, False),
        (40, 0.0, 1e-3, True),
    ],
)
def test_a_fit_whose_error_still_falls_is_not_converged(
    steps: int, power: float, error: float, marked: bool
) -> None:
    found = caveat(history(power, error, steps), {"steps": steps}, {"value": 0.2, "error": 0.002})
    assert ("not converged" in found) == marked


@pytest.mark.parametrize("power", [0.2, 0.4, 0.8])
def test_twice_the_time_gains_half_of_what_the_second_half_did(power: float) -> None:
    """A slope that is known well outweighs what the number of steps suggests."""
    found = cost(history(power), {})
    assert found.doubling == pytest.approx(2 ** (-power / 2), rel=0.2 * power)
    # Of an uncertain slope, less weight is left; of one that is hardly known, none.
    uncertain = cost(history(power, error=0.12), {})
    assert found.doubling is not None
    assert uncertain.doubling is not None
    assert math.log(uncertain.doubling) > 0.7 * math.log(found.doubling)
    records = history(power, error=0.2)
    assert cost(records, {}).doubling is None
    # The same queries tell how the error changed better than how large it is.
    paired = cost([r | {"change_error": 1e-4} for r in records], {})
    assert paired.doubling == pytest.approx(found.doubling, rel=1e-3)
    assert cost([r | {"change_error": 0.2} for r in records], {}).doubling is None


def test_only_a_flat_curve_says_that_longer_training_is_useless() -> None:
    for power, useless in ((0.02, True), (-0.2, True), (0.25, False)):
        found = cost(history(power), {})
        assert found.doubling is not None
        assert (found.doubling >= FLAT) == useless
        assert (next_step(found, fitted(0.2, 0.002)).kind == "none") == useless
    # An error as uncertain as that of a glossy metal tells neither.
    for records in (history(0.02, error=0.4), history(0.25, error=0.4)):
        assert cost(records, {}).doubling is None


def test_half_of_the_distance_to_the_training_error_is_overfitting() -> None:
    # Least squares with k free numbers and noise s² in n queries misses others by s²k/n, and seems to miss
    # its own by -s²k/n.
    found = cost(history(0.5), errors(0.2 + 0.05, 0.2 - 0.05), noise_variance=0.3)
    assert found.noise_share == pytest.approx(0.05 / 0.25)
    for same in (errors(0.25, 0.248), errors(0.25, 0.3), {}, errors(math.nan, 0.1)):
        assert cost(history(0.5), same, noise_variance=0.3).noise_share is None
    # Few queries without noise leave the same distance: what lies between them was not learned.
    for noise, share in ((None, None), (0.0, None), (0.03, 0.12), (1.0, 0.2)):
        found = cost(history(0.5), errors(0.25, 0.15), noise_variance=noise)
        assert found.noise_share == (share if share is None else pytest.approx(share))


@pytest.mark.parametrize(("density", "kind"), [(50, "queries"), (800, "time"), (None, "time")])
def test_noisy_training_queries_limit_longer_training(density: float | None, kind: str) -> None:
    """The basket weave at 50 queries per texel, 16 paths each: twice of 400 steps left 1.04 of the error,
    twice the queries 0.69. The same noise in many queries per texel hardly matters."""
    free, found = (cost(history(0.3), {}, noise_ratio=1.4, queries_per_texel=d) for d in (None, density))
    assert free.doubling is not None
    assert found.doubling is not None
    if kind == "queries":
        assert found.doubling > FLAT
    else:
        assert found.doubling == pytest.approx(free.doubling, abs=0.02)
    step = next_step(found, fitted(0.2, 0.002, training=0.19))
    assert step.kind == kind
    # Of an unknown error, too.
    lost = [r | {"unexplained": None, "unexplained_error": None} for r in history(0.3)]
    found = cost(lost, {}, noise_ratio=4.0, queries_per_texel=density)
    unknown = {"test": {"n": 8, "unexplained": {"value": None, "error": None}}}
    assert next_step(found, unknown).kind == ("queries" if kind == "queries" else "test")
    assert ("140%" in step.reason) == (kind == "queries")


def of(doubling: float | None, share: float | None = None, steps: int = 4000, **more: Any) -> MarginalCost:
    return MarginalCost(doubling, share, steps, **more)


NOISY = {"noise": 1.4, "density": 50, "noise_limit": 0.5}
UNKNOWN = {"test": {"n": 8, "unexplained": {"value": None, "error": None}}}


@pytest.mark.parametrize(
    ("cost", "errors", "kind"),
    [
        (of(0.9, 0.1), fitted(0.2, 0.04), "time"),
        (of(0.9, 0.3), fitted(0.2, 0.04), "queries"),
        (of(None, 0.3), fitted(0.2, 0.04), "queries"),
        (of(None), fitted(0.2, 0.04), "time"),
        (of(0.99, 0.05), fitted(0.2, 0.04), "none"),
        # Few steps: those that still learn, also overfitting, and those to which noise leaves nothing.
        (of(0.99, steps=90), fitted(0.2, 0.002), "time"),
        (of(0.85, 0.5, 146), fitted(0.6, 0.01), "time"),
        (of(0.99, 0.5, 146), fitted(0.6, 0.01), "queries"),
        (of(0.97, steps=200), fitted(0.82, 0.04), "time"),
        (of(0.947, steps=283), {"test": fitted(0.26, 0.05)["test"] | {"ten_largest": 0.47}}, "test"),
        # Neither is known of an uncertain or an undefined error, unless training queries are too few.
        (of(0.8), fitted(0.2, 0.06), "test"),
        (of(0.8), UNKNOWN, "test"),
        (of(0.8), {"test": fitted(0.2, 0.04)["test"] | {"ten_largest": 0.69}}, "test"),
        (of(0.8, 0.3), fitted(0.22, 0.06, training=0.2), "queries"),
        (of(0.8, **NOISY), fitted(0.22, 0.06, training=0.2), "queries"),
        (of(0.8), fitted(0.22, 0.06, training=0.03), "queries"),
        (of(0.8), fitted(0.22, 0.06, training=0.14), "test"),
        (of(0.8), fitted(0.22, 0.12, training=0.03), "test"),
        # Worse than the mean value: training queries that were learned, or not yet.
        (of(0.8), fitted(1.4, 0.1), "queries"),
        (of(0.8), fitted(1.4, 0.1, training=1.2), "time"),
        # An earlier state was kept, whatever the curve shows, and overfitting is left or not.
        (of(0.6, 0.4, kept_step=480, **NOISY), fitted(0.2, 0.002), "queries"),
        (of(1.5, 0.12, kept_step=480), fitted(0.2, 0.002), "queries"),
        (of(0.8, 0.08, kept_step=480), fitted(0.2, 0.002), "none"),
        (of(0.8, kept_step=480), fitted(0.22, 0.06, training=0.2), "queries"),
        (of(None, None, 90, kept_step=32), fitted(1.2, 0.1), "queries"),
    ],
)
def test_the_next_step_is_what_pays_most(cost: MarginalCost, errors: dict[str, Any], kind: str) -> None:
    assert next_step(cost, errors).kind == kind
