"""The own materials: the script makes exactly the stored files, and they are what a tile must be."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from conftest import RunPython
from numpy.typing import NDArray
from PIL import Image
from support.paths import ASSETS

MATERIALS = ("twisted_wool", "straight_wool", "turtle_shell", "cliff_rock", "insulation_foam")
# A height map below a BSDF or a coat, and a mesh.
FURTHER = ("coated_copper", "brushed_aluminum", "fish_scales")


def pixels(path: Path) -> NDArray[Any]:
    if path.suffix == ".exr":
        with OpenEXR.File(str(path), separate_channels=True) as file:
            (channel,) = file.channels().values()
            return np.array(channel.pixels)
    with Image.open(path) as image:
        return np.asarray(image)


# NumPy picks its loops by the processor; without them it computes as on the oldest one.
@pytest.mark.parametrize(
    ("features", "materials"),
    [
        ("", ("cliff_rock",)),
        ("AVX512F AVX512_SKX AVX512_ICL AVX2 FMA3 X86_V4 X86_V3", (*MATERIALS, *FURTHER)),
    ],
    ids=["this processor", "the oldest"],
)
def test_the_script_makes_the_stored_files(
    features: str, materials: tuple[str, ...], tmp_path: Path, run_python: RunPython
) -> None:
    command = ["-W", "ignore", str(ASSETS / "make_assets.py"), str(tmp_path), *materials]
    done = run_python(*command, NPY_DISABLE_CPU_FEATURES=features)
    assert done.returncode == 0, done.stderr
    made = {p.relative_to(tmp_path) for p in tmp_path.rglob("*") if p.is_file()}
    assert made == {p.relative_to(ASSETS) for m in materials for p in (ASSETS / m).iterdir()}
    for name in made:
        new, stored = tmp_path / name, ASSETS / name
        if name.suffix in (".exr", ".png"):
            assert pixels(new).dtype == pixels(stored).dtype
            assert np.array_equal(pixels(new), pixels(stored)), name
        else:
            assert new.read_bytes() == stored.read_bytes(), name
