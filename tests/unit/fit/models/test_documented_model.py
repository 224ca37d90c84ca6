"""The model of CONTRIBUTING.md is found by its name, and evaluated; a package of others may bring it, too."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import RunPython
from support.paths import ROOT

from mbtf_core.data.lattice import Lattice
from mbtf_fit.models import names_in
from mbtf_fit.models.model import Model
from mbtf_fit.pytorch.material import NeuralMaterial
from mbtf_fit.sections import NetworkSection


def documented() -> str:
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "CONTRIBUTING.md").read_text(), re.DOTALL)
    return str(code)


def test_the_documented_model_works() -> None:
    code, made = documented(), dict[str, Any]()
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


@pytest.mark.parametrize(
    ("point", "fault"),
    [
        ("texel-lobe = their_models:TexelLobe", ""),
        ("texel-lobe = their_models:Missing", "has no attribute 'Missing'"),
        ("other = their_models:TexelLobe", "no model of this name"),
        ("neumip = their_models:Named", "has the same name"),
    ],
)
def test_another_package_brings_a_model(
    tmp_path: Path, run_python: RunPython, point: str, fault: str
) -> None:
    """By an entry point, without a change of the project."""
    named = "\n\nclass Named(TexelLobe):\n    name, description = 'neumip', 'theirs'\n"
    (tmp_path / "their_models.py").write_text(documented() + named)
    info = tmp_path / "their_models-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: their_models\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[mbtf.models]\n{point}\n")
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    done = run_python("-m", "mbtf_fit", "no-such-shards", "--model", point.split(" ")[0], PYTHONPATH=path)
    assert done.returncode == 3
    assert "Traceback" not in done.stderr
    assert (fault or "no-such-shards") in done.stderr
    if not fault:
        assert "texel-lobe" in run_python("-m", "mbtf_fit", "--help", PYTHONPATH=path).stdout
