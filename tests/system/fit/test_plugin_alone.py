"""The plugin works in a process that cannot import PyTorch."""

from __future__ import annotations

from pathlib import Path

from conftest import RunPython
from support.paths import ROOT
from support.plugin_materials import write_material

from mbtf_gen.engine.runtime import OLDEST_LLVM

PROJECT = ROOT
MOVE = "import os, sys; os.chdir(sys.argv[1])\n"

CODE = """
import sys
for name in ("torch", "scipy", "trimesh", "matplotlib"):
    sys.modules[name] = None  # importing it fails
import mbtf_fit.backends.mitsuba
mbtf_fit.backends.mitsuba.register("llvm_ad_rgb")
import mitsuba as mi
scene = mbtf_fit.backends.mitsuba.load_scene({
    "type": "scene", "integrator": {"type": "mbtf_path", "max_depth": 3}, "light": {"type": "constant"},
    "ball": {"type": "sphere", "b": {"type": "mbtf", "material": sys.argv[1], "uv_scale": 3.0}},
    "sensor": {"type": "perspective",
               "to_world": mi.ScalarTransform4f().look_at([0, 3, 3], [0, 0, 0], [0, 0, 1]),
               "film": {"type": "hdrfilm", "width": 8, "height": 8}},
})
import numpy as np
mean = np.array(mi.render(scene, spp=4)).mean()
assert 0.05 < mean < 5, mean
mbtf_fit.backends.mitsuba.register()
print("rendered")
"""


def test_rendering_without_pytorch(tmp_path: Path, run_python: RunPython) -> None:
    write_material(tmp_path)
    # Without the path of the compiler in the environment, registration must find it.
    done = run_python("-c", CODE, str(tmp_path), DRJIT_LIBLLVM_PATH=None)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["rendered"]


def test_the_example_of_the_documentation_runs(tmp_path: Path, run_python: RunPython) -> None:
    write_material(tmp_path / "material")
    page = (PROJECT / "docs" / "how-to" / "render-in-mitsuba.md").read_text(encoding="utf-8")
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
    (tmp_path / "scene.xml").write_bytes((PROJECT / "examples" / "ball.xml").read_bytes())
    code = (
        "import mbtf_fit.backends.mitsuba\nmbtf_fit.backends.mitsuba.register('llvm_ad_rgb')\n"
        "scene = mbtf_fit.backends.mitsuba.load_scene('scene.xml', spp=9)\n"
        "print(type(scene.integrator()).__name__, scene.shapes()[0].bsdf().uv_scale.x, "
        "scene.sensors()[0].sampler().sample_count())"
    )
    done = run_python("-c", MOVE + code, str(tmp_path), DRJIT_LIBLLVM_PATH=None)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["ConePath", "[8]", "9"]


def test_a_late_import_is_refused(run_python: RunPython) -> None:
    code = """
import drjit.llvm, mitsuba as mi
try:
    mi.set_variant("llvm_ad_rgb")
    import drjit as dr
    dr.eval(mi.Float(1))
except Exception:
    print("no LLVM without ours")
else:
    try:
        import mbtf_fit.backends.mitsuba
        print("registered", drjit.detail.llvm_version()[0])
    except Exception as error:
        print(error)
"""
    done = run_python("-c", code, DRJIT_LIBLLVM_PATH=None)
    assert done.returncode == 0, done.stderr
    message = done.stdout.strip()
    if message.startswith("registered"):
        assert int(message.split()[1]) >= OLDEST_LLVM
    else:
        assert message == "no LLVM without ours" or message.startswith("Dr.Jit was imported first")
