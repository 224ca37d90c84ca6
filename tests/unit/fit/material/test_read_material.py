"""The reader of the documentation: NumPy, material.json and the tensors give every material's values."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.plugin_materials import write_material

from mbtf_fit.material.numpy_reader import NumpyMaterial
from mbtf_fit.models.registry import MODELS

ENCODED = {"position": 3, "direction": 2, "direction_pi": False, "raw": True, "band_attenuation": True}
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    **{name: (name, {}) for name in MODELS},
    "concatenated": ("neumip", {"blending": "concatenate", "oversampling": 2, "activation": "sine"}),
    "six outputs": ("neumip", {"output_channels": 6, "output_transform": "softplus", "offset": "direct"}),
    "encoded": ("neumip", {"encoding": {**ENCODED, "footprint_filtered": True}, "activation": "leaky-relu"}),
    "half vector": ("neumip-baseline", {"encoding": {"half_vector": True}, "output_transform": "exp"}),
    "two places": ("relief", {"relief": {"places": 2, "frame": False}}),
    "four places": ("relief", {"relief": {"places": 4}, "output_channels": 6}),
    "no hints": ("relief", {"relief": {"hints": False, "gate": False}, "output_transform": "identity"}),
    "lone query": ("hierarchical", {"decoder": "mlp"}),
    "one module": ("hierarchical", {"layers": 3, "offset": "none", "width": 12}),
}


@pytest.mark.parametrize("surface", ["glossy", "diffuse", "coated"])
@pytest.mark.parametrize("case", CASES)
def test_the_reader_gives_the_conformance_values(case: str, surface: str, tmp_path: Path) -> None:
    model, network = CASES[case]
    if surface != "glossy" and model not in ("relief", "neumip+"):
        pytest.skip("knows no surface")
    calibration = 0.7 + 0.6 * torch.rand(2, 4, 5, 3, generator=torch.Generator().manual_seed(0))
    weights = {"calibration": calibration} if MODELS[model].calibrates else None
    options = {"aspect": 0.5, "network": network, "weights": weights}
    options |= {"glossy": surface != "diffuse", "coated": surface == "coated"}
    material = write_material(tmp_path, model=model, finest=3, **options)
    expected = material.conformance["rgb"]
    queries = [material.conformance[name] for name in ("u", "sigma", "omega_i", "omega_o")]
    found = NumpyMaterial.load(tmp_path).evaluate(*queries)
    assert expected.std() > 0
    np.testing.assert_array_less(abs(found - expected), 1e-4 * np.maximum(1.0, expected))
