"""``mbtf-fit export``: the same command again keeps its output; another one replaces nothing unasked."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from support.plugin_materials import write_material

from mbtf_core.app.console import run
from mbtf_fit.cli.app import app
from mbtf_fit.export import targets


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export") / "material"
    write_material(folder, finest=1)
    return folder


def export(source: Path, out: Path, *options: str) -> int:
    return run(app, ["export", str(source), "--to", "material", "-o", str(out), *options])


def stamps(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}


def test_the_same_command_again_keeps_the_export(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert export(source, out) == 0
    before = stamps(out)
    assert {"material.json", "weights.safetensors"} < before.keys()
    assert export(source, out) == 0
    assert stamps(out) == before


def test_a_file_beside_the_material_is_replaced_on_request_only(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    material = tmp_path / "material"
    shutil.copytree(source, material)
    line = ["export", str(material), "--to", "json"]
    assert run(app, line) == 0
    (material / "layers.json").write_text("mine")
    assert run(app, line) == 3
    assert "layers.json: is there already" in capsys.readouterr().err
    assert (material / "layers.json").read_text() == "mine"
    assert run(app, [*line, "--overwrite"]) == 0
    assert "mine" not in (material / "layers.json").read_text()


def test_one_export_does_not_mix_with_another(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["-o", str(tmp_path / "out"), "-q"]
    assert run(app, ["export", str(source), "--to", "web", *out]) == 0
    assert run(app, ["export", str(source), "--to", "web", *out]) == 0
    before = stamps(tmp_path / "out")
    sky = tmp_path / "sky.npy"
    np.save(sky, np.ones((2, 4, 3), np.float32))
    for words, what in (
        (["--to", "slang"], "to: ['web'] -> ['slang']"),
        ([], "to: ['web'] -> ['exr', 'json']"),
        (["--to", "web", "--environment", str(sky)], "environment"),
    ):
        assert run(app, ["export", str(source), *words, *out]) == 3
        message = capsys.readouterr().err
        assert what in message
        assert "--overwrite" in message
    assert stamps(tmp_path / "out") == before
    assert run(app, ["export", str(source), "--to", "slang", *out, "--overwrite"]) == 0
    assert set(os.listdir(tmp_path / "out")) == {"export.json", "material.slang", "material.bin"}


@pytest.mark.parametrize("name", targets())
def test_a_target_names_all_files_that_it_writes(source: Path, tmp_path: Path, name: str) -> None:
    if name in (libraries := {"gltf": "pygltflib", "usd": "pxr", "materialx": "MaterialX"}):
        pytest.importorskip(libraries[name])
    options = ["--texture-format", "unorm8"] if name == "dds" else []
    assert run(app, ["export", str(source), "--to", name, "-o", str(tmp_path / "out"), "-q", *options]) == 0
    written = set(os.listdir(tmp_path / "out")) - {"export.json"}
    assert written
    # A model that knows no surface has no heights.
    assert written <= set(targets()[name].files) - {"height.png"}
    documents = [path for path in (tmp_path / "out").iterdir() if path.suffix in (".gltf", ".usda", ".mtlx")]
    assert not any(word in path.read_text() for path in documents for word in ("height", "displacement"))
