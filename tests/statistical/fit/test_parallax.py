"""The neural offset reduces the error on a material with parallax, with noise and all levels of detail."""

from __future__ import annotations

import pytest
from support.fit_data import parallax, write_data

from mbtf_fit import FitConfig, FitResult, fit


@pytest.fixture(scope="module")
def fits(tmp_path_factory: pytest.TempPathFactory) -> dict[str, FitResult]:
    folder = tmp_path_factory.mktemp("parallax")
    shards = write_data(folder / "shards", parallax, train=60_000, test=20_000, finest=4, noise=0.03)
    options = {"steps": 400, "batch": 4000, "warmup": 20}
    return {
        model: fit(FitConfig.model_validate({"model": model, "training": options}), shards, folder / model)
        for model in ("neumip", "neumip-baseline")
    }


def test_the_offset_explains_what_the_baseline_cannot(fits: dict[str, FitResult]) -> None:
    found = {model: result.errors["test"]["unexplained"] for model, result in fits.items()}
    for estimate in found.values():
        assert estimate["error"] < 0.02
    assert found["neumip"]["value"] < 0.07
    assert found["neumip-baseline"]["value"] > 2 * found["neumip"]["value"]


@pytest.mark.parametrize("model", ["neumip", "neumip-baseline"])
def test_directions_never_trained_on_are_predicted(fits: dict[str, FitResult], model: str) -> None:
    errors = fits[model].errors
    seen, unseen = (errors[k]["mse"] for k in ("held_out_queries", "held_out_directions"))
    # The function is smooth: a hole of a tenth of the disk's radius costs little.
    assert unseen["value"] < 2 * seen["value"] + 4 * (unseen["error"] + seen["error"])
