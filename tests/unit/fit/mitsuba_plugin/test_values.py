"""The plugin's evaluator gives the values of the PyTorch model, for every option, level, seam and shape."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.fit_data import random_queries
from support.fuzzing import check_message
from support.plugin_materials import deviation, net, write_material
from support.scenes import mi

from mbtf_core.errors import InputError
from mbtf_core.lattice import Lattice

assert mi.variant()

from mbtf_fit.mitsuba_plugin import network  # noqa: E402
from mbtf_fit.mitsuba_plugin.evaluator import Evaluator  # noqa: E402
from mbtf_fit.mitsuba_plugin.material_arrays import read_material  # noqa: E402

RANDOM = torch.Generator().manual_seed(1)


def calibration(levels: int) -> dict[str, Any]:
    return {"weights": {"calibration": 0.7 + 0.6 * torch.rand((2, levels, 6, 3), generator=RANDOM)}}


VARIANTS: dict[str, dict[str, Any]] = {
    "neumip": {},
    "baseline": {"model": "neumip-baseline"},
    "tall tile": {"aspect": 2.3},
    "flat tile": {"aspect": 0.1},
    "one texel": {"finest": 0},
    "calibrated": calibration(4),
    "calibrated, one texel": {"finest": 0, **calibration(1)},
    "six outputs": net(output_channels=6),
    "direct offset": net(offset="direct", activation="leaky-relu", output_transform="softplus"),
    "concatenated": net(blending="concatenate", activation="sine", output_transform="exp"),
    "concatenated, one texel": {"finest": 0, **net(blending="concatenate")},
    "encoded": net(encoding={"position": 2, "direction": 2, "raw": True, "direction_xyz": True, "pi": False}),
    "encoded with pi": net(encoding={"position": 3, "direction": 1}, output_transform="identity"),
    "footprint_filtered": {"aspect": 0.5, **net(encoding={"position": 4, "footprint_filtered": True})},
    "attenuated": net(
        encoding={"position": 3, "direction": 3, "direction_pi": False, "band_attenuation": True}
    ),
    "fourth root": net(output_transform="fourth-root", channels=9, width=8, layers=2),
}
UNROLLED = ("neumip", "fourth root", "encoded")


@pytest.mark.parametrize("name", VARIANTS)
def test_conformance_and_random_queries(name: str, tmp_path: Path) -> None:
    options = VARIANTS[name]
    material = write_material(tmp_path, **options)
    # Unrolled kernels take a second to compile.
    plugin = Evaluator(read_material(tmp_path), "unrolled" if name in UNROLLED else "cooperative")
    stored = material.conformance
    known = [stored[k] for k in ("u", "sigma", "omega_i", "omega_o")]
    assert stored["rgb"].std() > 0.01
    assert deviation(plugin.evaluate(*known), stored["rgb"]) < 1e-4
    queries = random_queries(np.random.default_rng(3), 4000, Lattice(material.lattice.finest))
    queries["u"] = 5 * queries["u"] - 2
    queries["sigma"] *= np.float32(1.5)
    found, wanted = plugin.evaluate(*queries.values()), material.evaluate(*queries.values())
    assert deviation(found, wanted) < 1e-4


@pytest.mark.parametrize(
    "options",
    [{}, {"finest": 6, "contrast": 0.5}, {"model": "neumip-baseline", "finest": 6, "contrast": 1.0}],
)
def test_half_precision_errs_by_less_than_one_percent(options: dict[str, Any], tmp_path: Path) -> None:
    """Also where neighboring texels differ much, so that an offset's rounding would show."""
    material = write_material(tmp_path, **options)
    half = Evaluator(read_material(tmp_path), "half")
    queries = random_queries(np.random.default_rng(4), 20_000, material.lattice)
    assert 1e-5 < deviation(half.evaluate(*queries.values()), material.evaluate(*queries.values())) < 1e-2


def test_half_precision_does_not_round_inputs() -> None:
    """A difference of 2⁻¹², which half precision cannot hold beside 1, is seen by the first layer."""
    one = np.ones((1, 1), np.float32)
    layers = [(one, np.full(1, -1.0, np.float32)), (4096 * one, np.zeros(1, np.float32))]
    (found,) = network.Network(layers, "half")([mi.Float(1.0 + 2.0**-12)])
    assert found[0] == 1.0


def test_the_inception_decoder_is_refused(tmp_path: Path) -> None:
    write_material(tmp_path)
    path = tmp_path / "material.json"
    description = json.loads(path.read_text())
    description["model"] = "hierarchical"
    description["config"] |= {"model": "hierarchical", "network": {}}
    path.write_text(json.dumps(description))
    with pytest.raises(InputError, match="does not support the inception decoder") as caught:
        read_material(tmp_path)
    check_message(caught.value)


@pytest.mark.parametrize(
    ("network", "fault"),
    [
        ({"channels": 7, "output_channels": 6}, "has 3 outputs, not 6"),
        ({"encoding": {"direction": 2}}, "has the shape"),
        ({"activation": "gelu"}, "activation"),
    ],
)
def test_weights_of_other_networks_are_refused(network: dict[str, Any], fault: str, tmp_path: Path) -> None:
    write_material(tmp_path)
    path = tmp_path / "material.json"
    description = json.loads(path.read_text())
    description["config"]["network"] |= network
    path.write_text(json.dumps(description))
    with pytest.raises(InputError, match=fault) as caught:
        read_material(tmp_path)
    check_message(caught.value)
