"""The model of the page on models is fitted from its file; its package brings it, without changes here."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path

import numpy as np
import pytest
from conftest import RunPython
from support.documented import code_block
from support.fit_data import constant, write_data
from support.paths import ROOT

from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import InputError
from mbtf_fit import Material, evaluate, fit
from mbtf_fit.config import FitConfig, build_model
from mbtf_fit.models import names_in


def documented(language: str = "python") -> str:
    """The first block of a language."""
    return code_block("how-to/add-a-model.md", language)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the documented file, which is removed after its fit to a constant."""
    folder = tmp_path_factory.mktemp("own")
    write_data(folder / "shards", constant(0.2), train=4000, test=200, finest=2)
    file = folder / "my_model.py"
    file.write_text(documented())
    assert names_in(documented()) == ["texel-diffuse"]
    config = FitConfig.model_validate({"model": f"{file}:TexelDiffuse", "training": {"steps": 200}})
    assert fit(config, folder / "shards", folder / "out").as_dict()["model"] == "texel-diffuse"
    file.unlink()
    return folder


def test_a_model_of_a_file_is_fitted_and_read_without_the_file(fitted: Path) -> None:
    """Against the data's constant, in all directions; its name is stored, and its operations."""
    material = Material.load(fitted / "out")
    up = np.tile(np.float32([0.0, 0.0, 1.0]), (50, 1))
    u = np.random.default_rng(0).random((50, 2))
    value = material.evaluate(u, np.full(50, 0.1), up, up)
    assert np.abs(value - 0.2).max() < 0.01
    assert material.model.name == "texel-diffuse"
    assert evaluate(fitted / "out", fitted / "shards")["errors"]["test"]["psnr"]["value"] > 25


def test_the_network_of_the_page_is_fitted(fitted: Path, tmp_path: Path) -> None:
    """To a constant, at the width that the user sets; the network reads the level, too."""
    file = tmp_path / "my_network.py"
    text = code_block("how-to/add-a-model.md", "python", 1)
    file.write_text(text.replace('"half", "difference")', '"half", "difference[0:3]", "level")'))
    options = {"model": f"{file}:HalfVectorDecoder", "network": {"width": 8}, "training": {"steps": 100}}
    material = fit(FitConfig.model_validate(options), fitted / "shards", tmp_path / "out").material
    up = np.tile(np.float32([0.0, 0.0, 1.0]), (50, 1))
    value = material.evaluate(np.random.default_rng(0).random((50, 2)), np.full(50, 0.1), up, up)
    assert np.abs(value - 0.2).max() < 0.02
    weights = {name: tuple(tensor.shape) for name, tensor in material.model.state_dict().items()}
    assert weights["decoder.0.weight"] == (8, 7 + 4 * 3 + 1)


@pytest.mark.parametrize(
    ("changes", "name", "where", "what"),
    [
        ({}, "missing.py:TexelDiffuse", "missing.py", "no such file"),
        ({}, "my_model.py:Missing", "my_model.py", "has no class 'Missing'"),
        ({"import math": "import mathematics"}, None, "my_model.py:1", "ModuleNotFoundError"),
        ({"1 / math.pi": "1 / math.tau0"}, None, "my_model.py:18", "AttributeError"),
        ({", channels=3": ""}, None, "my_model.py:16", "argument: 'channels'"),
        ({"takes = ()": "takes = )"}, None, "my_model.py:10", "unmatched"),
        ({"channels=3": "chanels=3"}, None, "my_model.py:16", "'chanels'"),
        ({"def operations(": "def operation("}, None, "my_model.py", "did you mean 'operation'?"),
        ({'"albedo", "texel"': '"albedo", "text"'}, None, "my_model.py", "did you mean 'texel'?"),
        ({"_rate": "_rat"}, None, "defaults of my_model.py:TexelDiffuse", "'training.texture_learning_rat'"),
        ({'"texel-diffuse"': '"svbrdf"'}, None, "my_model.py:TexelDiffuse", "that of an installed model"),
    ],
)
def test_a_file_at_fault_is_named_with_its_line(
    changes: dict[str, str],
    name: str | None,
    where: str,
    what: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    text = documented()
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    Path("my_model.py").write_text(text)
    with pytest.raises(InputError) as caught:
        build_model(name or "my_model.py:TexelDiffuse", Lattice(2, 1.0))
    assert caught.value.where == where
    assert what in caught.value.message


def install(folder: Path, point: str = "") -> str:
    """Install the documented package, or one with another entry point; returns the path to import from."""
    project = tomllib.loads(documented("toml"))
    (module,) = project["tool"]["setuptools"]["py-modules"]
    named = "\n\nclass Named(TexelDiffuse):\n    name, description = 'neumip', 'theirs'\n"
    named += "\n\nclass Quits(type):\n    def __getattr__(self, name): raise SystemExit('no more')\n"
    named += "\n\nclass Quits(metaclass=Quits):\n    pass\n"
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
    fit = ["shards", "--model", "texel-diffuse", "--steps", "20", "-o", "out"]
    export = ["export", "out", "--to", "exr", "--to", "json", "--to", "slang", "-o", "exported"]
    code = (
        f"import os; os.chdir({str(tmp_path)!r})\n"
        "from mbtf_core.app.console import run\nfrom mbtf_fit.cli.app import app\n"
        f"for line in ({fit!r}, {export!r}, ['--help']): assert run(app, line) == 0\n"
    )
    done = run_python("-c", code, PYTHONPATH=path)
    assert done.returncode == 0, done.stderr
    assert '"model": "texel-diffuse"' in (tmp_path / "exported" / "layers.json").read_text()
    assert "texel-diffuse" in done.stdout


@pytest.mark.parametrize(
    ("point", "fault"),
    [
        ("texel-diffuse = my_model:Missing", "has no attribute 'Missing'"),
        ("neumip = my_model:Named", "has the same name"),
        ("other = my_model:TexelDiffuse", "has the name 'texel-diffuse'"),
        ("quits = my_model:Quits.now", "no more"),
    ],
)
def test_a_package_at_fault_is_named(tmp_path: Path, run_python: RunPython, point: str, fault: str) -> None:
    """In the list, and where its model is asked for; those of the project can be used."""
    path, name = install(tmp_path, point), point.split(" ")[0]
    listed = run_python("-m", "mbtf_fit", "models", PYTHONPATH=path)
    assert listed.returncode == 0, listed.stderr
    assert fault in listed.stdout
    done = run_python("-m", "mbtf_fit", "no-such-shards", "--model", name, PYTHONPATH=path)
    assert done.returncode == 3
    assert "Traceback" not in done.stderr
    assert ("no-such-shards" if name == "neumip" else fault) in done.stderr
