"""Quantized textures: blocks, and stored materials."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.numpy import load_file
from support.plugin_materials import replace_tensors, write_material

from mbtf_core.errors import InputError
from mbtf_fit import Material
from mbtf_fit.backends.mitsuba.stored_material import read_material
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
from mbtf_fit.ops.constants import HEIGHTS, MAPS

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
def test_few_steep_texels_leave_the_other_moments_their_steps(form: TextureFormat) -> None:
    levels = [np.random.default_rng(n).random((n, n, 8), np.float32) for n in (16, 32)]
    levels[1][:2, :2] = 100.0
    rounded = round_levels(MAPS, levels, form)
    apart = np.abs(levels[0] - rounded[0]).reshape(-1, 8).max(0)
    others = [0, 1, 5, 6, 7]
    assert apart[2:5].max() < 0.02 < apart[others].min()
    assert (rounded[1][:2, :2, others] == 100.0).all()
    again = round_levels(MAPS, rounded, form)
    assert all(np.array_equal(a, b) for a, b in zip(rounded, again, strict=True))


@pytest.mark.parametrize("form", QUANTIZED)
@pytest.mark.parametrize("options", [{"model": "relief", "aspect": 0.75}, {"model": "neumip"}])
def test_all_readers_decode_the_same_numbers(
    options: dict[str, Any], form: TextureFormat, tmp_path: Path
) -> None:
    material, error = round_material(write_material(tmp_path / "float", **options), form)
    assert error.relative is not None
    assert 0 < error.relative < 0.25
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
