"""Exports of models of one's own: right, or refused in one line; never wrong with exit code 0."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from support.plugin_materials import TRAINING
from torch import Tensor

from mbtf_core.app.console import run
from mbtf_core.data.lattice import Lattice
from mbtf_fit import ops
from mbtf_fit.backends.shader.backend import SHADER
from mbtf_fit.cli.app import app
from mbtf_fit.config import FitConfig
from mbtf_fit.export import targets
from mbtf_fit.material import numpy_reader
from mbtf_fit.material.material import export
from mbtf_fit.ops.operation import _KINDS, Operation, Value
from mbtf_fit.pytorch.material import NeuralMaterial
from mbtf_fit.pytorch.operations import PYTORCH, Execution

DOCUMENTS = {"gltf", "usd", "materialx"}


def write(folder: Path, *last: Operation) -> Path:
    """A material whose list ends so, from `color` (3)."""
    operations = [
        ops.Lookup("texel", "u", "level", "texels", 3),
        ops.Transform("color", "texel", "softplus", 0.5),
        *last,
    ]
    model = NeuralMaterial(Lattice(2, 1.0), operations, "own")
    generator = torch.Generator().manual_seed(0)
    for textures in model.textures():
        torch.nn.init.normal_(textures.texels, generator=generator)
    folder.mkdir()
    export(model, FitConfig(), folder, data={"hash": "0" * 64}, training=TRAINING)
    return folder


def command(material: Path, out: Path, name: str) -> int:
    options = ["--texture-format", "unorm8"] if name == "dds" else []
    return run(app, ["export", str(material), "--to", name, "-o", str(out), *options])


@pytest.fixture(scope="module")
def supported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    last = ops.Gate("value", "texel", "color", floor=0.5)
    return write(tmp_path_factory.mktemp("own") / "material", last)


@pytest.fixture(scope="module")
def ripple(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A material with an operation that PyTorch alone has."""

    @dataclass(frozen=True)
    class Ripple(Operation):
        x: Value
        omega_i: Value

        def size(self, sizes: Any) -> int:
            return int(sizes[0])

    @PYTORCH.implements(Ripple)
    def _ripple(op: Ripple, run: Execution, x: Tensor, omega_i: Tensor) -> Tensor:
        return x * (1.0 + 0.5 * torch.sin(7.0 * omega_i[:, :1]))

    yield write(tmp_path_factory.mktemp("ripple") / "material", Ripple("value", "color", "omega_i"))
    del _KINDS["ripple"], PYTORCH._functions[Ripple]


# Networks alone need no other operation.
@pytest.mark.parametrize("name", sorted(targets().keys() - DOCUMENTS - {"rtxns"}))
def test_an_operation_that_readers_lack_is_refused(
    ripple: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Maps are fitted to values, and a material folder is read where the operation is."""
    code = command(ripple, tmp_path / "out", name)
    error = capsys.readouterr().err
    if name == "material":
        assert code == 0
        return
    assert code == 3
    lacks = "no place for the texture" if name == "dds" else "does not support the operation 'ripple'"
    assert lacks in error
    assert "Traceback" not in error
    assert not {path.name for path in (tmp_path / "out").glob("*")} & set(targets()[name].files)


@pytest.mark.parametrize("name", ["slang", "web"])
def test_shader_code_of_others_is_refused(
    ripple: Path,
    tmp_path: Path,
    name: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def theirs(op: Any, code: Any, x: Any, omega_i: Any) -> str:
        return f"{x}"

    theirs.__module__ = "their_operations"
    monkeypatch.setitem(SHADER._functions, _KINDS["ripple"], theirs)
    assert command(ripple, tmp_path / "out", name) == 3
    assert "of the operation 'ripple' is from another package" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "fault"),
    [("exr", "gate"), ("json", "gate"), ("json", "numbers"), ("material", "numbers")],
)
def test_what_a_reader_evaluates_differently_is_refused(
    supported: Path,
    tmp_path: Path,
    name: str,
    fault: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if fault == "gate":
        monkeypatch.setitem(numpy_reader.OPERATIONS, "gate", lambda gate, x, floor, scale: 1.01 * floor * x)
    else:
        weights = NeuralMaterial.weights
        scaled = lambda self: {n: 1.02 * t for n, t in weights(self).items()}  # noqa: E731
        monkeypatch.setattr(NeuralMaterial, "weights", scaled)
    assert command(supported, tmp_path / "out", name) == 3
    assert "conformance values differ" in capsys.readouterr().err
    assert not (
        tmp_path / "out" / {"exr": "textures.exr", "json": "layers.json"}.get(name, "material.json")
    ).exists()
