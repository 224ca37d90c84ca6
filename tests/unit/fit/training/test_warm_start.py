"""Fits that start from another material's textures and offset."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from support.fit_data import parallax, write_data
from support.image_data import write_images

from mbtf_core.errors import InputError
from mbtf_fit import FitConfig, Material, fit


def config(model: str, start: Path | None, steps: int = 3, **network: Any) -> FitConfig:
    training = {"steps": steps, "batch": 256, "blur": {"initial_sigma": 0, "offset_sigma": 0}}
    options = {"init_from": None if start is None else str(start), "network": network, "training": training}
    return FitConfig.model_validate({"model": model, **options})


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """(images, material of a neumip that was fitted to queries of the same function)"""
    folder = tmp_path_factory.mktemp("start")
    shuffled = write_data(folder / "s", parallax, train=4000)
    fit(config("neumip", None, 200), shuffled, folder / "m")
    return write_images(folder / "d", parallax, train=40), folder / "m"


def test_textures_and_offset_are_copied(folders: tuple[Path, Path], tmp_path: Path) -> None:
    images, start = folders
    # At rates this low what training started from is what it ends with.
    rates = {"learning_rate": 1e-9, "texture_learning_rate": 1e-9}
    slow = {"steps": 1, "batch": 64, "blur": {"initial_sigma": 0, "offset_sigma": 0}, **rates}
    options = {"model": "hierarchical", "training": slow}
    weights = {}
    for name, more in (("own", {}), ("taken", {"init_from": str(start)})):
        fit(FitConfig.model_validate({**options, **more}), images, tmp_path / name)
        weights[name] = Material.load(tmp_path / name).model.weights()
    given = Material.load(start).model.weights()
    for key, tensor in weights["taken"].items():
        shared = key.startswith(("pyramid.", "offset_"))
        source = given if shared else weights["own"]
        torch.testing.assert_close(tensor, source[key], atol=1e-6, rtol=0)
    assert given["offset_texture.0"].std() > 0.01
    assert not torch.allclose(weights["own"]["pyramid.3"], weights["taken"]["pyramid.3"], atol=0.01)


@pytest.mark.parametrize(
    ("network", "lost"), [({"channels": 5}, "pyramid.0"), ({"offset": "direct"}, "offset_network")]
)
def test_other_textures_are_refused_with_a_hint(
    folders: tuple[Path, Path], tmp_path: Path, network: dict[str, Any], lost: str
) -> None:
    images, start = folders
    with pytest.raises(InputError, match=rf"'{lost}.*does not have the shape.*\n.*same levels"):
        fit(config("hierarchical", start, **network), images, tmp_path / "m")
