"""The model of CONTRIBUTING.md is found by its name, and evaluated."""

from __future__ import annotations

import re
from typing import Any

import torch
from support.paths import ROOT

from mbtf_core.data.lattice import Lattice
from mbtf_fit.models import names_in
from mbtf_fit.models.model import Model
from mbtf_fit.pytorch.material import NeuralMaterial
from mbtf_fit.sections import NetworkSection


def test_the_documented_model_works() -> None:
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "CONTRIBUTING.md").read_text(), re.DOTALL)
    made: dict[str, Any] = {}
    exec(compile(code, "CONTRIBUTING.md", "exec"), made)
    (model,) = (m for m in made.values() if isinstance(m, type) and issubclass(m, Model) and m is not Model)
    assert names_in(code) == [model.name]
    lattice = Lattice(3, 1.0)
    material = NeuralMaterial(lattice, model.operations(lattice, NetworkSection()), model.name)
    material.initialize(torch.Generator().manual_seed(0), 1.0)
    up = torch.tensor([[0.0, 0.0, 1.0]]).repeat(5, 1)
    value = material(torch.rand(5, 2), torch.full((5,), 0.1), up, up)
    assert value.shape == (5, 3)
    assert (value > 0).all()
