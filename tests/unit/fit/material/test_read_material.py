"""The reader of the documentation: NumPy, material.json and the tensors give every material's values."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.material_cases import ALL, make

from mbtf_fit.material.numpy_reader import NumpyMaterial
from mbtf_fit.models.registry import MODELS


@pytest.mark.parametrize("case", ALL)
def test_the_reader_gives_the_conformance_values(case: str, tmp_path: Path) -> None:
    material = make(case, tmp_path / "material")
    expected = material.conformance["rgb"]
    queries = [material.conformance[name] for name in ("u", "sigma", "omega_i", "omega_o")]
    found = NumpyMaterial.load(tmp_path / "material").evaluate(*queries)
    assert (expected.std() > 0) == (case != "black")
    np.testing.assert_array_less(abs(found - expected), 1e-4 * np.maximum(1.0, expected))


def test_every_model_is_read() -> None:
    assert {options.get("model", "neumip") for options in ALL.values()} == set(MODELS)
