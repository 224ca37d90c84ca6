"""DDS files of quantized textures, read by independent decoders."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from PIL import Image
from safetensors.numpy import load_file
from support.plugin_materials import write_material

from mbtf_core.app.console import CONSOLE, run
from mbtf_core.errors import InputError, UsageError
from mbtf_fit import Material
from mbtf_fit.cli.app import app
from mbtf_fit.export import Export, targets
from mbtf_fit.export.dds import HEADER_BYTES
from mbtf_fit.material.texture_formats import TextureFormat


@pytest.mark.parametrize("model", ["relief", "cloth"])
def test_hardware_textures_are_those_of_the_material(model: str, tmp_path: Path) -> None:
    """Numbers of Pillow's and imagecodecs' decoders, with the ranges of layers.json, are the material's, but
    for their rounding to 8 bits; a material that is exported in the same format has the same textures."""
    write_material(tmp_path / "m", model=model)
    line = ["export", str(tmp_path / "m"), "--texture-format", "bc4", "-q"]
    assert run(app, [*line, "--to", "dds", "--to", "material", "-o", str(tmp_path / "out")]) == 0
    again = ["export", str(tmp_path / "out"), "--to", "dds", "-o", str(tmp_path / "again"), "-q"]
    assert run(app, again) == 0
    material = Material.load(tmp_path / "out")
    assert material.texture_format == "bc4"
    weights = material.model.weights()
    ranges = json.loads((tmp_path / "out" / "layers.json").read_text())["ranges"]
    stored = load_file(tmp_path / "out" / "weights.safetensors")
    assert all(np.allclose(found, stored[f"{name}.range"], rtol=1e-6) for name, found in ranges.items())
    fibers = {"surface.fibers"} if model == "cloth" else set()
    assert {"pyramid", "surface.maps", "surface.horizons", "surface.heights"} | fibers == ranges.keys()
    for name in ("pyramid", *fibers):
        data = (tmp_path / "out" / f"{name}.dds").read_bytes()
        assert (tmp_path / "again" / f"{name}.dds").read_bytes() == data
        levels = sorted(n for n in weights if n.startswith(f"{name}."))
        finest = weights[levels[-1]].numpy()
        low, high = np.array(ranges[name])
        pair = 2 - finest.shape[2] % 2
        shown = np.atleast_3d(np.asarray(Image.open(io.BytesIO(data))))[..., :pair]
        assert np.array_equal(np.atleast_3d(imagecodecs.dds_decode(data))[..., :pair], shown)
        expected = 255 * (finest - low) / np.where(high > low, high - low, 1)
        assert np.array_equal(shown, np.floor(expected[..., :pair] + 1e-3))
        # The second level of the last slice, by its place in the file.
        rows, columns, channels = finest.shape
        blocks = [-(-max(rows >> k, 1) // 4) * -(-max(columns >> k, 1) // 4) for k in range(len(levels))]
        assert len(data) == HEADER_BYTES + 8 * channels * sum(blocks)
        start = HEADER_BYTES + 8 * ((channels - pair) * sum(blocks) + pair * blocks[0])
        kind = imagecodecs.BCN.FORMAT.BC5 if pair == 2 else imagecodecs.BCN.FORMAT.BC4
        part, shape = data[start : start + 8 * pair * blocks[1]], (rows // 2, columns // 2, pair)
        found = np.asarray(imagecodecs.bcn_decode(part, kind, shape=shape[: pair + 1])).reshape(shape)
        coarse = weights[levels[-2]].numpy()
        expected = (coarse - low) / np.where(high > low, high - low, 1)
        assert np.array_equal(found, np.floor(255 * expected[..., -pair:] + 1e-3))
    heights = np.frombuffer(
        (tmp_path / "out" / "surface.heights.dds").read_bytes(), np.uint16, -1, HEADER_BYTES
    )
    (low,), (high,) = ranges["surface.heights"]
    expected = weights["surface.heights"].numpy().ravel()
    np.testing.assert_allclose(low + (high - low) * heights / 65535, expected, atol=1e-7)


def test_headers_are_those_of_direct3d(tmp_path: Path) -> None:
    """Size, mip levels, capabilities, format and slices, of a tile that is half as high as wide; slices lie
    one after the other, each with its mip levels."""
    write_material(tmp_path / "m", model="relief", finest=3, aspect=0.5)
    line = ["export", str(tmp_path / "m"), "--texture-format", "bc4", "-q", "--to", "dds", "--to", "material"]
    assert run(app, [*line, "-o", str(tmp_path / "out")]) == 0
    weights = Material.load(tmp_path / "out").model.weights()
    # DXGI_FORMAT_BC5_UNORM, _R8G8_UNORM, _R16_UNORM.
    formats = {"pyramid": 83, "surface.maps": 49, "surface.horizons": 49, "surface.heights": 56}
    for name, form in formats.items():
        pair = 1 if name == "surface.heights" else 2
        data = (tmp_path / "out" / f"{name}.dds").read_bytes()
        levels = [weights[f"{name}.{s}"] for s in range(9) if f"{name}.{s}" in weights] or [weights[name]]
        rows, columns, channels = np.atleast_3d(levels[-1].numpy()).shape
        assert struct.unpack_from("<4s7I", data) == (b"DDS ", 124, 0x21007, rows, columns, 0, 0, len(levels))
        assert struct.unpack_from("<2I4s", data, 76) == (32, 4, b"DX10")
        assert struct.unpack_from("<I", data, 108) == (0x401008,)
        # A two-dimensional texture.
        assert struct.unpack_from("<5I", data, 128) == (form, 3, 0, channels // pair, 0)
        if name == "surface.maps":
            low, high = np.array(json.loads((tmp_path / "out" / "layers.json").read_text())["ranges"][name])
            start = HEADER_BYTES + 2 * sum(x.shape[0] * x.shape[1] for x in levels)
            second = np.frombuffer(data, np.uint8, 2 * rows * columns, start).reshape(rows, columns, 2)
            expected = (levels[-1].numpy() - low) / np.where(high > low, high - low, 1)
            np.testing.assert_allclose(second / 255, expected[..., 2:4], atol=1e-5)


@pytest.mark.parametrize(
    ("form", "aspect", "fault"),
    [
        ("float32", 1.0, "no textures in float32"),
        ("unorm8", 0.75, "are no mip levels"),
        ("bc4", 0.75, "multiples of 4"),
    ],
)
def test_what_hardware_cannot_read_is_refused(
    form: TextureFormat, aspect: float, fault: str, tmp_path: Path
) -> None:
    material = write_material(tmp_path, aspect=aspect)
    with pytest.raises((InputError, UsageError), match=fault):
        targets()["dds"].write(Export(tmp_path, tmp_path, material, form, CONSOLE), None)
    assert not (tmp_path / "layers.json").exists()
