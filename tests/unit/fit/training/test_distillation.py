"""Fits distill a sampler, which material folders keep."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from support.fit_data import F32, Function, constant, write_data

from mbtf_core.app.console import run
from mbtf_fit import FitConfig, Material, fit
from mbtf_fit.cli.app import app
from mbtf_fit.ops import Lookup, Network
from mbtf_fit.ops.operation import Operation, sizes_of


def highlight(u: F32, sigma: F32, omega_i: F32, omega_o: F32) -> NDArray[np.float64]:
    """A wide one about the mirror direction."""
    away = np.square(omega_i[:, :2] + omega_o[:, :2]).sum(1)
    return np.repeat(np.exp(-away[:, None] / 0.2, dtype=np.float64), 3, 1)


@pytest.mark.parametrize(
    ("function", "steps", "wanted", "sampled"),
    [
        (highlight, 20, True, True),
        (constant(0.3), 20, True, False),
        (highlight, 8, True, False),
        (highlight, 20, False, False),
    ],
)
def test_fits_of_highlights_have_a_sampler_but_short_ones(
    function: Function, steps: int, wanted: bool, sampled: bool, tmp_path: Path
) -> None:
    data = write_data(tmp_path / "data", function, train=20_000)
    training = {"steps": steps, "importance_sampling": wanted}
    config = FitConfig.model_validate({"model": "neumip", "training": training})
    sampler = fit(config, data, tmp_path / "fit").material.sampler
    assert (sampler is not None) == sampled
    if sampler is not None:
        copy = ["export", str(tmp_path / "fit"), "--to", "material", "-o", str(tmp_path / "copy")]
        assert run(app, copy) == 0
        kept = Material.load(tmp_path / "copy").sampler
        assert kept is not None
        assert kept.operations == sampler.operations
        assert all(torch.equal(kept.tensors[name], t) for name, t in sampler.tensors.items())


@pytest.mark.parametrize("name", ["sampler", "sampler_maps"])
def test_names_of_the_sampler_are_reserved(name: str) -> None:
    color = Network("value", ("f",), "decoder", (), 3)
    cases: list[list[Operation]] = [
        [Lookup(name, "u", "level", "map", 4), Network("value", (name,), "decoder", (), 3)],
        [Lookup("f", "u", "level", name, 4), color],
        [Lookup("f", "u", "level", "map", 4), Network("value", ("f",), name, (), 3)],
    ]
    for operations in cases:
        with pytest.raises(ValueError, match="importance sampling"):
            sizes_of(operations)
