"""Fits that start from another material's textures, offsets and heights."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from support.fit_data import parallax, write_data
from support.image_data import write_images
from support.known_surfaces import geometry, rough_heights

from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import InputError
from mbtf_fit import FitConfig, Material, fit

# At rates this low what training starts from is what it ends with.
SLOW = {"steps": 1, "batch": 64, "learning_rate": 1e-9, "texture_learning_rate": 1e-9}
SLOW |= {"energy_calibration": False, "blur": {"initial_sigma": 0, "min_sigma": 0, "offset_sigma": 0}}


def config(model: str, training: dict[str, Any], **options: Any) -> FitConfig:
    return FitConfig.model_validate({"model": model, "training": training, **options})


@pytest.mark.parametrize(
    ("model", "first", "shared"),
    [
        ("hierarchical", "neumip", ("pyramid.", "offset_")),
        ("relief", "relief", ("pyramid.", "depth_weights")),
        ("neumip+", "neumip+", ("pyramid.", "depth_weights", "surface.heights")),
    ],
)
def test_what_the_models_share_is_copied(
    model: str, first: str, shared: tuple[str, ...], tmp_path: Path
) -> None:
    """All else, the decoder and a known surface included, is that of the fit."""
    rough = geometry(Lattice(3), rough_heights(16, 16), roughness=0.4, metallic=0.7, seed=0)
    data = write_data(tmp_path / "rough", parallax, train=4000, geometry=rough)
    fit(config(first, {"steps": 100, "batch": 256}), data, tmp_path / "first")
    given = Material.load(tmp_path / "first").model.weights()
    if model == "hierarchical":
        data = write_images(tmp_path / "data", parallax, train=40)
    else:
        data = write_data(tmp_path / "data", parallax, train=1000, test=100)
    own, taken = (
        fit(config(model, SLOW, init_from=start), data, tmp_path / name).material.model.weights()
        for name, start in (("own", None), ("taken", str(tmp_path / "first")))
    )
    for key, tensor in taken.items():
        source = given if key.startswith(shared) else own
        # Normals and horizons follow learned heights.
        if model != "neumip+" or not key.startswith(("surface.maps", "surface.horizons")):
            torch.testing.assert_close(tensor, source[key], atol=1e-6, rtol=0)
    for start in shared:
        changes = [float((given[key] - own[key]).abs().max()) for key in given if key.startswith(start)]
        assert max(changes) > 1e-4, start


def test_other_textures_are_refused_with_a_hint(tmp_path: Path) -> None:
    shuffled = write_data(tmp_path / "s", parallax, train=1000)
    fit(config("neumip", {"steps": 1, "batch": 256}), shuffled, tmp_path / "first")
    images = write_images(tmp_path / "d", parallax, train=4)
    other = config("hierarchical", SLOW, init_from=str(tmp_path / "first"), network={"channels": 5})
    with pytest.raises(InputError, match=r"'pyramid.0.*does not have the shape.*\n.*same levels"):
        fit(other, images, tmp_path / "m")
