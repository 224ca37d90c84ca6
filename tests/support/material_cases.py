"""Materials of random weights that need all that a reader or a back end may have to evaluate."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from mbtf_core.data.lattice import Lattice
from mbtf_fit import ops
from mbtf_fit.config import FitConfig
from mbtf_fit.material.material import Material, export
from mbtf_fit.material.rounding import round_material
from mbtf_fit.material.transmittance import Transmittance
from mbtf_fit.pytorch.material import NeuralMaterial

from .plugin_materials import TRAINING, net, write_material

BANDS = {"position": 3, "direction": 2, "direction_pi": False, "raw": True}
CASES: dict[str, dict[str, Any]] = {
    "calibrated": {},
    "holes": {},
    "direct offset, six outputs": net(
        offset="direct",
        output_channels=6,
        activation="leaky-relu",
        output_transform="fourth-root",
        encoding={"direction_xyz": True, "half_vector": True},
    ),
    "four levels, softplus": {"model": "quartesan2022", **net(output_transform="softplus")},
    "baseline, encoded": {
        "model": "neumip-baseline",
        **net(encoding={**BANDS, "band_attenuation": True, "footprint_filtered": True}),
    },
    "relief": {"model": "relief"},
    "relief, diffuse, four places": {"model": "relief", "glossy": False, **net(relief={"places": 4})},
    "relief under a coat": {"model": "relief", "coated": True, **net(relief={"places": 2})},
    "shadow rays under a coat": {
        "model": "relief",
        "coated": True,
        **net(relief={"places": 2, "shadow_rays": True}),
    },
    "relief without hints": {"model": "relief", **net(relief={"hints": False}, oversampling=1)},
    "relief without gate": {
        "model": "relief",
        **net(relief={"gate": False, "frame": False}, output_channels=6),
    },
    "learned heights": {"model": "neumip+"},
    "cloth": {"model": "cloth", "glossy": False, **net(relief={"places": 2, "shadow_rays": True})},
    "black": {"model": "relief", "weights": {"unit": torch.zeros(())}},
    "bounded, in blocks": {"model": "relief", "weights": {"most": torch.tensor(0.5)}},
    "rainer2019": {"model": "rainer2019"},
    "svbrdf": {"model": "svbrdf"},
    "zeltner2024": {"model": "zeltner2024", **net(width=12, layers=3)},
}

# Operations that no model of the papers has, and values of more than four numbers.
LISTS: dict[str, list[ops.Operation]] = {
    "constant light": [ops.Lookup("color", "u", None, "map", 3), ops.Transform("value", "color", "softplus")],
    "frames without axes": [
        ops.Lookup("texel", "u", "level", "axes", 18),
        *(ops.ToFrame(f"local_{k}", f"texel[{6 * k}:{6 * k + 6}]", "omega_o") for k in range(3)),
        ops.ToFrame("light", "texel[0:6]", "omega_i"),
        ops.Gate("mixed", "local_0", "local_1", "local_2"),
        ops.Gate("both", "mixed", "light", "mixed"),
        ops.Transform("value", "both", "softplus"),
    ],
    "wide values": [
        ops.Lookup("texel", "u", "level", "lobes", 10),
        ops.Frequencies("waves", "omega_i[0:2]", None, 2, pi=False, attenuated=True),
        ops.Matrix("wide", "waves", tuple(tuple(0.1 * (i - j) for j in range(8)) for i in range(5))),
        ops.Gate("gated", "wide", "texel[2:7]", "texel[5:10]", floor=0.2),
        ops.Standardize("scaled", "gated", "texel[0:5]", "wide"),
        ops.Transform("positive", "scaled", "softplus"),
        ops.DivideByCosine("lit", "positive", "omega_i", 0.3),
        ops.Product("squares", ("lit", "positive")),
        ops.Matrix("value", "squares", ((0.2, 0.0, 0.0, 0.0, 0.1), (0.0, 0.2, 0.1, 0.0, 0.0), (0.1,) * 5)),
    ],
}
# Numbers of frames: without normal, without tangent, with a tangent along the normal.
DEGENERATE = [0.0, 0.0, -1.0, 0.3, 0.2, 0.1, 0.3, 0.2, 0.0, -1.0, 0.0, 0.0, 0.3, 0.6, -0.1, -0.4, 1.2, 1.8]
CASES |= {case: {} for case in LISTS}
HIERARCHICAL = {
    "hierarchical": {"model": "hierarchical"},
    "hierarchical, one module": {"model": "hierarchical", **net(layers=3, offset="none", width=12)},
    "hierarchical, eleven channels": {
        "model": "hierarchical",
        **net(decoder="mlp", channels=11, encoding={"raw": True, "direction_xyz": True}),
    },
}
# The same, and those that take long in a browser.
ALL: dict[str, dict[str, Any]] = {
    **CASES,
    "neumip": {},
    "encoded with pi": net(encoding={"position": 3, "direction": 1}, output_transform="identity"),
    "half vector": net(encoding={"half_vector": True}, output_transform="exp", channels=9, width=8, layers=2),
    "rainer2020": {"model": "rainer2020"},
    "calibrated relief": {"model": "relief"},
    "tracing alone": {
        "model": "relief",
        "coated": True,
        "glossy": False,
        **net(relief={"hints": False, "frame": False, "gate": False}, oversampling=2),
    },
    "learned heights, diffuse": {"model": "neumip+", "glossy": False},
    **HIERARCHICAL,
}


def make(case: str, folder: Path, **more: Any) -> Material:
    """A material of random weights on a tile that is half as high as wide."""
    lattice, generator = Lattice(4, 0.5), torch.Generator().manual_seed(0)
    if case in LISTS:
        model = NeuralMaterial(lattice, LISTS[case])
        for textures in model.textures():
            torch.nn.init.normal_(textures.texels, std=0.5, generator=generator)
            if case == "frames without axes":
                textures.texels.data[:] = torch.tensor(DEGENERATE)
        folder.mkdir(parents=True)
        return export(model, FitConfig(), folder, data={"hash": "0" * 64}, training=TRAINING)
    options = {"finest": 4, "aspect": 0.5, **ALL[case], **more}
    if case in ("calibrated", "calibrated relief", "holes"):
        options["weights"] = {
            "calibration": 0.7 + 0.6 * torch.rand((2, options["finest"] + 1, 6, 3), generator=generator)
        }
    if case == "holes":
        shapes = [(*lattice.shape(s), 6) for s in range(5)]
        layers = [
            [0.15 + 0.1 * torch.randn(s, generator=generator).numpy() for s in shapes] for _ in range(2)
        ]
        options["transmittance"] = Transmittance(lattice, (-0.05, -0.2), layers)
    material = write_material(folder, **options)
    if not case.endswith("in blocks"):
        return material
    model = round_material(material, "bc4")[0].model
    return export(model, material.config, folder, data={"hash": "0" * 64}, training=TRAINING, form="bc4")
