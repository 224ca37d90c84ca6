"""The plugin works in a process that cannot import PyTorch."""

from __future__ import annotations

from pathlib import Path

from conftest import RunPython
from support.plugin_materials import write_material

CODE = """
import sys
for name in ("torch", "scipy", "trimesh", "matplotlib"):
    sys.modules[name] = None  # importing it fails
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import mbtf_fit.plugin
scene = mbtf_fit.plugin.load_scene({
    "type": "scene", "integrator": {"type": "mbtf_path", "max_depth": 3}, "light": {"type": "constant"},
    "ball": {"type": "sphere", "b": {"type": "mbtf", "material": sys.argv[1], "uv_scale": 3.0}},
    "sensor": {"type": "perspective",
               "to_world": mi.ScalarTransform4f().look_at([0, 3, 3], [0, 0, 0], [0, 0, 1]),
               "film": {"type": "hdrfilm", "width": 8, "height": 8}},
})
import numpy as np
mean = np.array(mi.render(scene, spp=4)).mean()
assert 0.05 < mean < 5, mean
mbtf_fit.plugin.register()
print("rendered")
"""


def test_rendering_without_pytorch(tmp_path: Path, run_python: RunPython) -> None:
    write_material(tmp_path)
    # `python -c` finds the packages as the test does; the early import sets the path to the compiler.
    done = run_python("-c", "import mbtf_gen\n" + CODE, str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["rendered"]


def test_registration_says_what_it_misses(run_python: RunPython) -> None:
    code = """
import mbtf_fit.plugin
try:
    mbtf_fit.plugin.register()
except Exception as error:
    print(error)
import mitsuba as mi
mi.set_variant("scalar_rgb")
try:
    mbtf_fit.plugin.register()
except Exception as error:
    print(error)
mi.set_variant("llvm_ad_rgb")
mbtf_fit.plugin.register()
mbtf_fit.plugin.register()
print("done")
"""
    done = run_python("-c", code)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0] == "no variant of Mitsuba is set"
    assert lines[2] == "the plugin 'mbtf' does not run in the variant scalar_rgb"
    assert lines[-1] == "done"
