"""Networks for RTX Neural Shading, read back as its host network reads them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.material_cases import make
from support.plugin_materials import TRAINING

from mbtf_core.app.console import run
from mbtf_core.data.lattice import Lattice
from mbtf_fit import ops
from mbtf_fit.cli.app import app
from mbtf_fit.config import FitConfig
from mbtf_fit.material.material import Material, export
from mbtf_fit.material.rounding import round_material
from mbtf_fit.pytorch.material import NeuralMaterial

ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "relu": lambda x: np.maximum(x, 0.0),
    "leaky-relu": lambda x: np.maximum(x, 0.01 * x),
    "sine": np.sin,
}


class HostNetwork:
    """Reads ``layers`` alone, as NeuralNetwork.cpp does: half precision, one width of all hidden layers."""

    def __init__(self, path: Path) -> None:
        self.document = json.loads(path.read_text())
        layers = self.document["layers"]
        channels = [layers[0]["num_inputs"], *(layer["num_outputs"] for layer in layers)]
        assert 2 <= len(layers) <= 8
        self.inputs, width, outputs = channels[0], channels[1], channels[-1]
        assert channels[1:-1] == [width] * (len(layers) - 1)
        self.layers = []
        for k, layer in enumerate(layers):
            rows, columns = (outputs if k == len(layers) - 1 else width), (width if k else self.inputs)
            assert (layer["num_inputs"], layer["num_outputs"]) == (columns, rows)
            numbers = [np.array(layer[name], np.float64) for name in ("weights", "biases")]
            assert all((n == n.astype(np.float16)).all() for n in numbers)
            self.layers.append((numbers[0].reshape(rows, columns), numbers[1]))

    def __call__(self, x: np.ndarray) -> np.ndarray:
        for k, (weight, bias) in enumerate(self.layers):
            x = x @ weight.T + bias
            if k < len(self.layers) - 1:
                x = ACTIVATIONS[self.document["activation"]](x)
        return x


def unequal(folder: Path) -> Material:
    """Of a network whose layers are of several widths."""
    operations = [
        ops.Lookup("texel", "u", "level", "features", 4),
        ops.Network("x", ("texel", "omega_i", "omega_o"), "mixed", (9, 5, 7), 3, "leaky-relu"),
        ops.Transform("value", "x", "softplus"),
    ]
    folder.mkdir()
    model = NeuralMaterial(Lattice(2, 1.0), operations)
    return export(model, FitConfig(), folder, data={"hash": "0" * 64}, training=TRAINING)


@pytest.mark.parametrize(
    ("case", "names"),
    [
        ("four levels, softplus", ["offset_network", "decoder", "sampler"]),
        ("zeltner2024", ["decoder"]),
        ("unequal", ["mixed"]),
    ],
)
def test_networks_are_those_of_the_material(
    case: str, names: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = tmp_path / "material", tmp_path / "out"
    more = {"sampled": True} if "sampler" in names else {}
    material = unequal(folder) if case == "unequal" else make(case, folder, **more)
    assert run(app, ["export", str(folder), "--to", "rtxns", "-o", str(out)]) == 0
    left = "left out, as a single layer or more than 8: 'frames'"
    assert (left in capsys.readouterr().out) == (case == "zeltner2024")
    rounded, _ = round_material(material, "float16")
    assert len(list(out.glob("network-*.json"))) == len(names)
    for k, name in enumerate(names):
        found = HostNetwork(out / f"network-{k + 1}.json")
        assert found.document["network"] == name
        assert sum(found.document["inputs"].values()) == found.inputs
        x = np.random.default_rng(0).normal(size=(50, found.inputs))
        expected = _evaluate(material if name == "sampler" else rounded, name, x)
        assert expected.std() > 0.01
        np.testing.assert_allclose(found(x), expected, atol=2e-3 if name == "sampler" else 1e-5)


def _evaluate(material: Material, name: str, x: np.ndarray) -> Any:
    given = torch.from_numpy(x).float()
    if name != "sampler":
        with torch.no_grad():
            return material.model.get_submodule(name)(given).numpy()
    assert material.sampler is not None
    tensors = material.sampler.tensors
    for k in range(3):
        given = given @ tensors[f"sampler.{k}.weight"].T + tensors[f"sampler.{k}.bias"]
        given = given.relu() if k < 2 else given
    return given.numpy()


def test_what_the_format_lacks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bias = make("neumip", tmp_path / "first").model.weights()["decoder.0.bias"]
    make("neumip", tmp_path / "large", weights={"decoder.0.bias": 1e7 * bias})
    make("svbrdf", tmp_path / "none")
    for name, what in (("none", "has 0 networks of 2 to 8 layers"), ("large", "beyond half precision")):
        assert run(app, ["export", str(tmp_path / name), "--to", "rtxns", "-o", str(tmp_path / "out")]) == 3
        assert what in capsys.readouterr().err
