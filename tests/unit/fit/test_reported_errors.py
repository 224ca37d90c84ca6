"""Errors of predictions that foreign code made for the test queries, and the word for an error."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from conftest import RunPython
from support.fit_data import parallax, write_data

from mbtf_core.app.console import run
from mbtf_core.errors import InputError
from mbtf_fit.cli.app import app
from mbtf_fit.evaluation import score_predictions
from mbtf_fit.formatting import visibility

NOISE, OFFSET = 0.02, 0.01


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data(tmp_path_factory.mktemp("foreign"), parallax, train=100, test=1500, noise=NOISE)


def exact(shards: Path) -> np.ndarray:
    with np.load(shards / "test-00000.npz") as arrays:
        return parallax(*(arrays[name] for name in ("u", "sigma", "omega_i", "omega_o")))


def test_the_error_is_that_of_the_prediction_alone(shards: Path, tmp_path: Path) -> None:
    """A known offset; the noise of the data is twice as large and must not count."""
    value = exact(shards)
    np.savez(tmp_path / "mine.npz", value=value + OFFSET)
    errors = score_predictions(tmp_path / "mine.npz", shards)["errors"]["test"]
    assert run(app, ["evaluate", str(tmp_path / "mine.npz"), str(shards)]) == 0
    assert errors["n"] == 1500
    assert abs(errors["mse"]["value"] - OFFSET**2) < 4 * errors["mse"]["error"] < OFFSET**2
    assert math.isclose(errors["unexplained"]["value"], OFFSET**2 / value.var(0).mean(), rel_tol=0.3)


def test_foreign_predictions_are_scored_without_the_fitter(
    shards: Path, tmp_path: Path, run_python: RunPython
) -> None:
    """Neither models nor training have a part in the errors of foreign code."""
    np.savez(tmp_path / "mine.npz", value=exact(shards))
    code = "import sys; from mbtf_fit.evaluation import score_predictions; score_predictions(*sys.argv[1:])"
    rooms = "{m.split('.')[1] for m in sys.modules if m.startswith('mbtf_fit.')}"
    shown = f"{code}; print({rooms} & {{'models', 'pytorch', 'training'}})"
    done = run_python("-c", shown, str(tmp_path / "mine.npz"), str(shards))
    assert done.stdout.strip() == "set()", done.stderr


def test_what_cannot_be_scored_is_refused(shards: Path, tmp_path: Path) -> None:
    file = tmp_path / "mine.npz"
    with pytest.raises(InputError, match="no such file"):
        score_predictions(file, shards)
    np.savez_compressed(file, value=np.ones((1500, 3)))
    damaged = bytearray(file.read_bytes())
    damaged[60:90] = bytes(30)
    for content in (b"text", damaged, {"values": np.zeros((1500, 3))}, {"value": np.full(3, 1j)}):
        if isinstance(content, dict):
            np.savez(file, **content)
        else:
            file.write_bytes(content)
        with pytest.raises(InputError, match="no npz file"):
            score_predictions(file, shards)
    for shape in ((), (4500,), (1499, 3), (3, 1500)):
        np.savez(file, value=np.zeros(shape))
        with pytest.raises(InputError, match=r"shape .* 1500 test queries"):
            score_predictions(file, shards)
    value = exact(shards)
    value[[7, 9], 1] = math.nan, math.inf
    np.savez(file, value=value)
    with pytest.raises(InputError, match="at 2 queries, first at query 7"):
        score_predictions(file, shards)


@pytest.mark.parametrize(
    ("mse", "error", "text", "word"),
    [
        (1e-5, 1e-7, "PSNR 50.0 dB", "not visible"),
        (1e-3, 1e-5, "PSNR 30.0 dB", "visible"),
        # An error below its own uncertainty, which may be negative.
        (-1e-5, 2e-5, "PSNR above 45.2 dB", "not visible"),
        (0.0, 5e-4, "PSNR above 30.0 dB", "visible at most"),
        # A bound that excludes nothing.
        (0.0, 250.0, "PSNR unknown", None),
        (0.0, 0.005, "PSNR above 20.0 dB", None),
        (0.0, 0.0, "PSNR infinite", "not visible"),
    ],
)
def test_psnr_has_a_word(mse: float, error: float, text: str, word: str | None) -> None:
    # Four times the value is two stops less exposure, and the same picture.
    for factor, exposure in ((1, 0.0), (16, -2.0)):
        errors = {"value": factor * mse, "error": factor * error}
        assert visibility({"mse": errors, "exposure": exposure}) == (text, word)
