"""Elementary functions from exactly rounded operations: against NumPy, many digits, and exact cases."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbtf_gen.sampling.exact_math import exp, exp2, log, sincos_turns

TOLERANCE = 1e-14


def turns() -> NDArray[np.float64]:
    """Random turns, and those around the joints of the quarter turns."""
    joints = np.arange(-16, 17) / 8
    near = [joints + d for d in (0.0, 1e-16, -1e-16, 1e-9, -1e-9)]
    return np.concatenate([np.random.default_rng(0).uniform(-2.0, 2.0, 20_000), *near])


def test_sine_and_cosine_are_those_of_numpy() -> None:
    t = turns()
    sine, cosine = sincos_turns(t)
    # NumPy takes 2πt, which is itself rounded: up to 1e-15 of angle.
    np.testing.assert_allclose(sine, np.sin(2 * np.pi * t), rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(cosine, np.cos(2 * np.pi * t), rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(sine**2 + cosine**2, 1.0, rtol=0, atol=TOLERANCE)


def test_quarter_turns_are_exact() -> None:
    sine, cosine = sincos_turns(np.arange(-8, 9) / 4)
    quarter = np.arange(-8, 9) % 4
    np.testing.assert_array_equal(sine, np.array([0.0, 1.0, 0.0, -1.0])[quarter])
    np.testing.assert_array_equal(cosine, np.array([1.0, 0.0, -1.0, 0.0])[quarter])


def test_powers_of_two_are_those_of_numpy() -> None:
    x = np.concatenate([np.random.default_rng(1).uniform(-60, 60, 20_000), np.arange(-20, 20) + 0.5])
    np.testing.assert_allclose(exp2(x), np.exp2(x), rtol=TOLERANCE)
    whole = np.arange(-1000, 1000)
    np.testing.assert_array_equal(exp2(whole.astype(np.float64)), np.ldexp(1.0, whole))


def test_exponentials_and_logarithms_are_those_of_numpy() -> None:
    rng = np.random.default_rng(3)
    x = np.concatenate([rng.uniform(-60, 60, 20_000), [0.0]])
    np.testing.assert_allclose(exp(x), np.exp(x), rtol=TOLERANCE)
    y = np.concatenate([np.exp(x), np.nextafter(1.0, [0.0, 2.0]), [1e-300, 1e300]])
    np.testing.assert_allclose(log(y), np.log(y), rtol=TOLERANCE)
    assert log(np.array([1.0]))[0] == 0.0
    whole = np.arange(-900, 900)
    assert (np.rint(log(np.ldexp(1.0, whole)) / np.log(2.0)) == whole).all()
