"""A material without its textures as JSON: ``material.json`` with the numbers of the tensors."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from mbtf_core.files.atomic import write_text
from mbtf_fit.export import Export, ExportTarget
from mbtf_fit.material.texture_formats import QUANTIZED, grouped, range_of

LAYERS_NAME = "layers.json"
_SCHEMA = 7


def _numbers(array: Any) -> Any:
    """Nested lists of decimals that single precision reads as exactly these numbers."""
    stored = np.asarray(array, np.float32)
    return float(str(stored[()])) if stored.ndim == 0 else [_numbers(row) for row in stored]


def write(export: Export, options: None) -> list[str]:
    """Write what evaluates a material, but for its textures: its operations, the tensors that they name, the
    ranges of quantized textures, and the conformance queries with their expected values, that of the
    transmittance included."""
    from mbtf_fit.export.checks import check_stored
    from mbtf_fit.material.material import describe_model
    from mbtf_fit.material.transmittance import FORMULA

    material = export.material
    weights, expected = material.model.weights(), dict(material.conformance)
    through, textures = material.transmittance, grouped(weights) if export.form in QUANTIZED else {}
    ranges = {
        texture: _numbers(range_of(texture, [weights[name].cpu().numpy() for name in names]))
        for texture, names in textures.items()
    }
    if through is not None:
        expected["transmittance"] = through.evaluate(*(expected[k] for k in ("u", "sigma", "omega_o")))
    document = {
        "format": "mbtf-layers",
        "schema": _SCHEMA,
        "precision": export.form,
        **describe_model(material.model),
        "textures": [name for name, tensor in weights.items() if tensor.ndim == 3],
        "tensors": {name: _numbers(tensor.cpu()) for name, tensor in weights.items() if tensor.ndim != 3},
        **({"ranges": ranges} if ranges else {}),
        **(
            {}
            if through is None
            else {"transmittance": {"depths": _numbers(through.depths), "formula": FORMULA}}
        ),
        "conformance": {
            **{name: _numbers(array) for name, array in expected.items()},
            "tolerance": material.description["conformance"]["tolerance"],
        },
    }
    path = export.folder / LAYERS_NAME
    write_text(path, json.dumps(document, indent=1))
    written = json.loads(path.read_text(encoding="utf-8"))
    texels = {name: weights[name].cpu().numpy() for name in written["textures"]}
    check_stored(written, written["tensors"] | texels, material, path)
    return [LAYERS_NAME]


TARGET = ExportTarget(
    "json",
    "the operations and all tensors but the textures, with conventions and queries with expected values",
    [LAYERS_NAME],
    write,
)
