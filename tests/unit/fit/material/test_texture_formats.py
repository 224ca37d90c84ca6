"""Quantized textures: blocks, stored materials, and training that sees them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.numpy import load_file
from support.fit_data import parallax, write_data
from support.killed_fits import run_killed
from support.known_surfaces import geometry, rough_heights
from support.plugin_materials import replace_tensors, write_material

import mbtf_fit.training.fit
from mbtf_core.data.dataset import Dataset
from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import InputError
from mbtf_fit import FitConfig, Material, fit
from mbtf_fit.backends.mitsuba.stored_material import read_material
from mbtf_fit.data.loader import load_training
from mbtf_fit.material.material import export
from mbtf_fit.material.numpy_reader import NumpyMaterial
from mbtf_fit.material.rounding import round_material
from mbtf_fit.material.texture_formats import (
    QUANTIZED,
    TextureFormat,
    decode_blocks,
    encode_blocks,
    round_levels,
)
from mbtf_fit.native import library
from mbtf_fit.ops.constants import HEIGHTS
from mbtf_fit.training.trainer import Trainer, prepare_trainer

SHAPES = [(1, 1), (2, 2), (3, 5), (8, 8), (24, 32)]


def random_levels() -> list[NDArray[np.float32]]:
    """Of coarse, medium and fine contrast."""
    random = np.random.default_rng(0)
    levels = [random.normal(size=(*shape, 3)).astype(np.float32) for shape in SHAPES]
    levels[-1][:, :16] *= 0.005
    levels[-1][:, 16:24] *= 0.02
    return levels


@pytest.mark.parametrize(("rows", "columns"), SHAPES)
def test_blocks_are_those_of_an_independent_decoder(rows: int, columns: int) -> None:
    """It rounds down to 8 bits. Flat blocks are among them."""
    numbers = 255 * np.random.default_rng(1).random((rows, columns, 2))
    numbers[:4, :4, 1] = 77
    blocks = encode_blocks(numbers)
    height, width = 4 * blocks.shape[0], 4 * blocks.shape[1]
    for k in range(2):
        data = np.ascontiguousarray(blocks[:, :, k]).tobytes()
        found = np.asarray(imagecodecs.bcn_decode(data, imagecodecs.BCN.FORMAT.BC4, shape=(height, width)))
        whole = decode_blocks(blocks, rows, columns)[..., k]
        assert np.array_equal(found.reshape(height, width)[:rows, :columns], whole // 7)


@pytest.mark.parametrize("form", QUANTIZED)
def test_the_error_is_half_a_step_and_rounding_again_changes_nothing(form: TextureFormat) -> None:
    levels = random_levels()
    rounded = round_levels("pyramid", levels, form)
    span = max(float(np.ptp(np.concatenate([x[..., k].ravel() for x in levels]))) for k in range(3))
    # Of a block: half a step between its end points, which are rounded by half a step.
    step = span / 255 if form == "unorm8" else span / 7 + span / 255
    apart = max(float(np.abs(a - b).max()) for a, b in zip(levels, rounded, strict=True))
    assert apart <= 0.501 * step
    again = round_levels("pyramid", rounded, form)
    assert all(np.array_equal(a, b) for a, b in zip(rounded, again, strict=True))
    heights = -np.random.default_rng(0).random((5, 7, 1)).astype(np.float32)
    (found,) = round_levels(HEIGHTS, [heights], form)
    assert np.abs(found - heights).max() <= 0.5001 / 65535
    assert found.max() == heights.max()


@pytest.mark.parametrize("form", QUANTIZED)
@pytest.mark.parametrize("options", [{"model": "relief", "aspect": 0.75}, {"model": "neumip"}])
def test_all_readers_decode_the_same_numbers(
    options: dict[str, Any], form: TextureFormat, tmp_path: Path
) -> None:
    material, error = round_material(write_material(tmp_path / "float", **options), form)
    assert error.relative is not None
    assert 0 < error.relative < 0.2
    out = tmp_path / form
    out.mkdir()
    training = material.description["training"]
    written = export(material.model, material.config, out, data={}, training=training, form=form)
    assert written.texture_format == form
    weights = written.model.weights()
    assert all(torch.equal(weights[name], tensor) for name, tensor in material.model.weights().items())
    read, stored = read_material(out).tensors, NumpyMaterial.load(out)
    for name, tensor in weights.items():
        assert np.array_equal(read[name], tensor.numpy())
        np.testing.assert_allclose(stored.tensors[name], tensor.numpy(), rtol=3e-7, atol=1e-7)
    queries = [written.conformance[k] for k in ("u", "sigma", "omega_i", "omega_o")]
    np.testing.assert_allclose(stored.evaluate(*queries), written.conformance["rgb"], rtol=2e-3, atol=1e-5)
    assert written.deviation() < 1e-5 * written.conformance["rgb"].max()


def test_damaged_blocks_are_refused(tmp_path: Path) -> None:
    material = round_material(write_material(tmp_path), "bc4")[0]
    training = material.description["training"]
    export(material.model, material.config, tmp_path, data={}, training=training, form="bc4")
    blocks = load_file(tmp_path / "weights.safetensors")["pyramid.3"]
    changes: list[dict[str, Any]] = [
        {"pyramid.3": blocks[:1]},
        {"pyramid.3": blocks[..., :4]},
        {"pyramid.range": None},
    ]
    for change in changes:
        export(material.model, material.config, tmp_path, data={}, training=training, form="bc4")
        replace_tensors(tmp_path, change)
        with pytest.raises(InputError, match=r"quantized texture 'pyramid\.\d' cannot be decoded"):
            Material.load(tmp_path)


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rough = geometry(Lattice(3), rough_heights(16, 16), roughness=0.4, metallic=0.7, seed=0)
    folder = tmp_path_factory.mktemp("data") / "shards"
    return write_data(folder, parallax, train=3000, test=500, noise=0.01, geometry=rough)


def config(form: str, steps: int, **training: Any) -> FitConfig:
    options = {"steps": steps, "batch": 300, "warmup": 3, "texture_format": form, **training}
    return FitConfig.model_validate({"training": options})


def trainer_of(shards: Path, form: str) -> Trainer:
    chosen = config(form, 10)
    data = Dataset.open(shards)
    partition = load_training(data, chosen.held_out, chosen.seed)
    return prepare_trainer(chosen, data, partition, torch.device("cpu"))


@pytest.mark.parametrize("kernel", [True, False], ids=["kernel", "pytorch"])
def test_gradients_at_rounded_textures_pass_to_the_texels(
    shards: Path, kernel: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A step with a rounding is that of texels that have it already: without blur and first in Adam, whose
    first step is the sign of the gradient."""
    if not kernel:
        monkeypatch.setenv(library.ENVIRONMENT, "off")
        library.reload()
    moved = []
    for shifted in (False, True):
        trainer = trainer_of(shards, "float32")
        monkeypatch.setattr(trainer, "_sigmas", lambda: [0.0])
        monkeypatch.setattr(type(trainer.regularization), "decay", lambda *_: None)
        (texture,) = trainer.model.textures()
        delta = 0.3 * torch.randn(texture.texels.shape, generator=torch.Generator().manual_seed(1))
        if shifted:
            texture.texels.data += delta
        else:
            texture.rounding = delta
        before = texture.texels.detach().clone()
        with mbtf_fit.training.loop.Workers(trainer.device) as workers:
            next(trainer.steps(workers, 0))
        moved.append(texture.texels.detach() - before)
    assert moved[0].abs().max() > 1e-4
    np.testing.assert_allclose(moved[0], moved[1], atol=2e-6)
    monkeypatch.undo()
    library.reload()


def test_a_fit_with_blocks_is_killed_and_resumed(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its error is near that of single precision, and its material holds what training has seen last."""
    whole = fit(config("bc4", 60), shards, tmp_path / "bc4")
    exact = fit(config("float32", 60), shards, tmp_path / "float32")
    mine, other = (r.errors["test"]["unexplained"]["value"] for r in (whole, exact))
    assert mine < 1.2 * other
    sizes = [(tmp_path / n / "weights.safetensors").stat().st_size for n in ("bc4", "float32")]
    assert sizes[0] < 0.6 * sizes[1]
    assert whole.material.deviation() < 1e-5 * whole.material.conformance["rgb"].max()
    monkeypatch.setattr(mbtf_fit.training.fit, "_REPORT_SECONDS", 0.0)
    monkeypatch.setattr(mbtf_fit.training.fit, "_CHECKPOINT_SECONDS", 0.0)
    # Kills are at random steps of ten, the last five of which see blocks.
    straight = fit(config("bc4", 10), shards, tmp_path / "straight")
    found, _ = run_killed(monkeypatch, lambda: fit(config("bc4", 10), shards, tmp_path / "killed"))
    weights = straight.material.model.weights()
    assert all(torch.equal(t, weights[name]) for name, t in found.material.model.weights().items())
