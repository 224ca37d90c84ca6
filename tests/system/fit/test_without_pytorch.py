"""The plugin and ``mbtf-fit preview`` work in a process that cannot import PyTorch."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from conftest import RunPython
from PIL import Image
from support.commands import call, fails
from support.paths import ROOT
from support.plugin_materials import write_material

# The current folder is the first argument; importing what stands for None fails.
MOVE = "import os, sys; os.chdir(sys.argv[1])\n"
MOVE += "sys.modules |= dict.fromkeys(('torch', 'scipy', 'trimesh', 'matplotlib'))\n"


def test_the_example_of_the_documentation_runs(tmp_path: Path, run_python: RunPython) -> None:
    write_material(tmp_path / "material")
    page = (ROOT / "docs" / "how-to" / "render-in-mitsuba.md").read_text(encoding="utf-8")
    example = page.split("```python\n")[1].split("```")[0]
    quick = example.replace("spp=64", "spp=1").replace('"to_world": view', '"to_world": view, **SMALL')
    assert quick.count("SMALL") == 1
    assert quick.count("spp=1") == 1
    small = 'SMALL = {"film": {"type": "hdrfilm", "width": 8, "height": 8}}\n'
    done = run_python("-c", MOVE + small + quick, str(tmp_path), DRJIT_LIBLLVM_PATH=None)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "ball.png").stat().st_size > 0


def test_the_example_scene_in_xml_loads(tmp_path: Path, run_python: RunPython) -> None:
    write_material(tmp_path / "material")
    (tmp_path / "scene.xml").write_bytes((ROOT / "examples" / "ball.xml").read_bytes())
    code = (
        "import mbtf_fit.backends.mitsuba\nmbtf_fit.backends.mitsuba.register('llvm_ad_rgb')\n"
        "scene = mbtf_fit.backends.mitsuba.load_scene('scene.xml', spp=9)\n"
        "print(type(scene.integrator()).__name__, scene.shapes()[0].bsdf().uv_scale.x, "
        "scene.sensors()[0].sampler().sample_count())"
    )
    done = run_python("-c", MOVE + code, str(tmp_path), DRJIT_LIBLLVM_PATH=None)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["ConePath", "[8]", "9"]


BLOCKED = """
import socket, sys
for name in ("torch", "scipy", "trimesh"):
    sys.modules[name] = None  # importing it fails
def refuse(*a, **k):
    raise AssertionError("the network was asked for")
socket.socket.connect = refuse
from mbtf_fit.__main__ import main
sys.argv = ["mbtf-fit", *sys.argv[1:]]
sys.exit(main())
"""
SMALL = ("--size", "64", "--set", "sheet.tiles_across=[1, 3]")


def test_pictures_without_pytorch_kept_and_refused(tmp_path: Path, run_python: RunPython) -> None:
    write_material(tmp_path / "material", finest=1)
    words = ("preview", str(tmp_path / "material"), "-o", str(tmp_path / "out"))
    done = run_python("-c", BLOCKED, *words, *SMALL, "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert not report["kept"]
    with Image.open(tmp_path / "out/sheet.png") as sheet:
        assert sheet.width > 6 * 64

    def again(*options: str) -> dict[str, Any]:
        return call(["mbtf-fit", *words, *SMALL, *options, "--json"]).result()

    assert again()["kept"]
    shown = [again("--exposure", "1") for _ in range(2)]
    assert [one["kept"] for one in shown] == [False, True]
    assert (shown[0]["exposure"], shown[1]["exposure"]) == (1.0, 1.0) != (report["exposure"],) * 2
    only = ("--view", "60,-90", "--light", "45,45", "-o", str(tmp_path / "sheet"))
    call(["mbtf-fit", *words[:2], *SMALL, *only, "--json"]).result()
    with Image.open(tmp_path / "sheet/sheet.png") as picture:
        assert picture.width < 2 * 64
    message = fails(3, *words, *SMALL, "--light", "45,45")
    assert "another configuration: sheet.light" in message
