"""The model of the page on models is evaluated; its package of two files brings it, without a change here."""

from __future__ import annotations

import os
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import RunPython
from support.fit_data import constant, write_data
from support.paths import ROOT

from mbtf_core.data.lattice import Lattice
from mbtf_fit.models import names_in
from mbtf_fit.models.model import Model
from mbtf_fit.pytorch.material import NeuralMaterial
from mbtf_fit.sections import NetworkSection


def documented(language: str = "python") -> str:
    """The one block of a language."""
    page = (ROOT / "docs" / "how-to" / "add-a-model.md").read_text(encoding="utf-8")
    (code,) = re.findall(rf"```{language}\n(.*?)```", page, re.DOTALL)
    return str(code)


def test_the_documented_model_works() -> None:
    code, made = documented(), dict[str, Any]()
    exec(compile(code, "add-a-model.md", "exec"), made)
    (model,) = (m for m in made.values() if isinstance(m, type) and issubclass(m, Model) and m is not Model)
    assert names_in(code) == [model.name]
    lattice = Lattice(3, 1.0)
    material = NeuralMaterial(lattice, model.operations(lattice, NetworkSection()), model.name)
    material.initialize(torch.Generator().manual_seed(0), 1.0)
    up = torch.tensor([[0.0, 0.0, 1.0]]).repeat(5, 1)
    value = material(torch.rand(5, 2), torch.full((5,), 0.1), up, up)
    assert value.shape == (5, 3)
    assert (value > 0).all()


def install(folder: Path, point: str = "") -> str:
    """Install the documented package, or one with another entry point; returns the path to import from."""
    project = tomllib.loads(documented("toml"))
    (module,) = project["tool"]["setuptools"]["py-modules"]
    named = "\n\nclass Named(TexelLobe):\n    name, description = 'neumip', 'theirs'\n"
    (folder / f"{module}.py").write_text(documented() + named)
    ((group, points),) = project["project"]["entry-points"].items()
    lines = [point] if point else [f"{name} = {value}" for name, value in points.items()]
    info = folder / f"{module}-{project['project']['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("\n".join([f"[{group}]", *lines, ""]))
    return os.pathsep.join([str(folder), str(ROOT)])


def test_another_package_brings_a_model(tmp_path: Path, run_python: RunPython) -> None:
    """By an entry point: fitted, listed, exported."""
    path = install(tmp_path)
    write_data(tmp_path / "shards", constant(0.3), train=2000, test=200, finest=2)
    fit = ["shards", "--model", "texel-lobe", "--steps", "20", "-o", "out"]
    export = ["export", "out", "--to", "exr", "--to", "json", "--to", "slang", "-o", "exported"]
    code = (
        f"import os; os.chdir({str(tmp_path)!r})\n"
        "from mbtf_core.app.console import run\nfrom mbtf_fit.cli.app import app\n"
        f"for line in ({fit!r}, {export!r}, ['--help']): assert run(app, line) == 0\n"
    )
    done = run_python("-c", code, PYTHONPATH=path)
    assert done.returncode == 0, done.stderr
    assert '"model": "texel-lobe"' in (tmp_path / "exported" / "layers.json").read_text()
    assert "texel-lobe" in done.stdout


@pytest.mark.parametrize(
    ("point", "fault"),
    [
        ("texel-lobe = their_models:Missing", "has no attribute 'Missing'"),
        ("other = their_models:TexelLobe", "no model of this name"),
        ("neumip = their_models:Named", "has the same name"),
    ],
)
def test_a_package_at_fault_is_named(tmp_path: Path, run_python: RunPython, point: str, fault: str) -> None:
    path = install(tmp_path, point)
    done = run_python("-m", "mbtf_fit", "no-such-shards", "--model", point.split(" ")[0], PYTHONPATH=path)
    assert done.returncode == 3
    assert "Traceback" not in done.stderr
    assert fault in done.stderr
