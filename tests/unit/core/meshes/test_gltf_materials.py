"""Materials of glTF files: factors, textures and their places, by numbers from the specification."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.gltf_files import SQUARE_UV, GltfBuilder

from mbtf_core.meshes.content import MeshContent, MeshShape, Texture, numbers_of
from mbtf_core.meshes.read import read_mesh_content

# sRGB codes and their linear values (IEC 61966-2-1), to seven digits.
CODES = {0: 0.0, 10: 0.0030353, 128: 0.2158605, 200: 0.5775804, 255: 1.0}


def placed(builder: GltfBuilder, value: Any) -> Any:
    """Data with textures in place of their pixels."""
    if isinstance(value, np.ndarray):
        return {"index": builder.texture(value)}
    if isinstance(value, dict):
        return {key: placed(builder, item) for key, item in value.items()}
    return value


def plate_of(base: dict[str, Any] | None, builder: GltfBuilder | None = None, **more: Any) -> GltfBuilder:
    builder = builder or GltfBuilder()
    return builder.plate(builder.material(placed(builder, base), **placed(builder, more)))


def content_of(builder: GltfBuilder, folder: Path) -> MeshContent:
    return read_mesh_content(builder.write(folder / "a.glb"))


def shape_of(builder: GltfBuilder, folder: Path) -> MeshShape:
    (shape,) = content_of(builder, folder).shapes
    assert shape.faults == {}
    return shape


def texture_of(shape: MeshShape, role: str = "base_color") -> Texture:
    return shape.values[role][0]


def extension(name: str, **values: Any) -> dict[str, Any]:
    return {f"KHR_materials_{name}": values}


def codes(*pixels: Any, dtype: Any = np.uint8) -> np.ndarray:
    """An image of one row."""
    return np.array([pixels], dtype)


FOUR = codes((51, 102, 153, 204))
SHEEN_COLOR = codes((128, 128, 255))
COAT = {"clearcoatFactor": 0.5, "clearcoatTexture": FOUR}
COAT |= {"clearcoatRoughnessFactor": 0.25, "clearcoatRoughnessTexture": FOUR}
SHEEN = {"sheenColorFactor": [1, 0.5, 0], "sheenColorTexture": SHEEN_COLOR}
SHEEN |= {"sheenRoughnessFactor": 0.5, "sheenRoughnessTexture": FOUR}
ALPHA = {alpha: codes((255, 255, 255, alpha), (255, 255, 255, 255)) for alpha in (0, 51, 204, 255)}
HALF = {"baseColorFactor": [1, 1, 1, 0.5]}
BLEND, MASK = {"alphaMode": "BLEND"}, {"alphaMode": "MASK"}
# Material (its metallic and roughness, and the rest), and values by role; None: there are none.
VALUES: dict[str, tuple[dict[str, Any] | None, dict[str, Any], dict[str, Any]]] = {
    # An index of refraction of 1.5 reflects 4%, half of what `specular` 1 does.
    "nothing": (None, {}, {"base_color": [1, 1, 1], "roughness": 1, "metallic": 1, "specular": 0.5}),
    "factors": (
        {"baseColorFactor": [0.1, 0.2, 0.3, 1], "metallicFactor": 0, "roughnessFactor": 0.9},
        {},
        {"base_color": [0.1, 0.2, 0.3], "roughness": 0.9, "metallic": 0},
    ),
    "colors are sRGB": (
        {"baseColorTexture": codes((0, 10, 128), (200, 255, 255)), "baseColorFactor": [1, 1, 0.5, 1]},
        {},
        {"base_color": [[[0, CODES[10], CODES[128] / 2], [CODES[200], 1, 0.5]]]},
    ),
    "numbers are linear": (
        {"metallicRoughnessTexture": codes((65535, 13107, 26214), dtype=np.uint16), "roughnessFactor": 0.5},
        {},
        {"roughness": [[0.1]], "metallic": [[0.4]]},
    ),
    "coat": ({}, extension("clearcoat", **COAT), {"clearcoat": [[0.1]], "clearcoat_roughness": [[0.1]]}),
    "sheen": (
        {},
        extension("sheen", **SHEEN),
        {"sheen": 1, "sheen_color": [[[CODES[128], CODES[128] / 2, 0]]], "sheen_roughness": [[0.4]]},
    ),
    "bare coat": ({}, extension("clearcoat", clearcoatFactor=1), {"clearcoat": 1, "clearcoat_roughness": 0}),
    "specular weight": ({}, extension("specular", specularTexture=FOUR), {"specular": [[0.4]]}),
    "opaque": ({"baseColorTexture": ALPHA[0], **HALF}, {}, {"opacity": None}),
    "blended": ({"baseColorTexture": ALPHA[51], **HALF}, BLEND, {"opacity": [[0.1, 0.5]]}),
    "blended, without holes": ({"baseColorTexture": ALPHA[255]}, BLEND, {"opacity": None}),
    "masked": ({"baseColorTexture": ALPHA[0]}, MASK, {"opacity": [[0, 1]], "opacity_cutoff": 0.5}),
    "masked, all above the cutoff": ({"baseColorTexture": ALPHA[204]}, MASK, {"opacity": None}),
}


@pytest.mark.parametrize("name", VALUES)
def test_values_of_materials(tmp_path: Path, name: str) -> None:
    base, more, expected = VALUES[name]
    known = {key: more[key] for key in more.keys() & {"alphaMode"}}
    extensions = {key: more[key] for key in more.keys() - known.keys()}
    values = shape_of(plate_of(base, extensions=extensions, **known), tmp_path).values
    for role, wanted in expected.items():
        if wanted is None:
            assert role not in values
        else:
            assert numbers_of(values[role]) == pytest.approx(np.array(wanted), abs=1e-6), role


@pytest.mark.parametrize(("codes", "wrap"), [(33648, "mirror"), (33071, "clamp"), (None, "repeat")])
def test_samplers(tmp_path: Path, codes: int | None, wrap: str) -> None:
    builder = GltfBuilder()
    sampler = {} if codes is None else {"wrapT": codes, "magFilter": 9728}
    base = {"baseColorTexture": {"index": builder.texture(np.zeros((2, 2, 3), np.uint8), sampler)}}
    found = texture_of(shape_of(plate_of(base, builder), tmp_path))
    assert found.wrap == ("repeat", wrap)
    assert found.nearest == (codes is not None)


def place(found: Texture, u: float, v: float) -> list[float]:
    """Where a point of the shape, v down, lies in the image, v down."""
    x, y = found.to_uv @ (u, 1 - v, 1)
    return [round(float(x), 6), round(1 - float(y), 6)]


@pytest.mark.parametrize(
    ("transform", "at", "expected"),
    [
        ({"offset": [0, 1], "scale": [1, -1]}, (0.2, 0.3), [0.2, 0.7]),
        # The example of the extension: the lower left quarter of the image, turned clockwise.
        ({"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]}, (1, 0), [0, 0.5]),
        # Scaled before it is turned.
        ({"rotation": np.pi / 2, "scale": [2, 3]}, (1, 0), [0, -2]),
    ],
)
def test_texture_transforms(
    tmp_path: Path, transform: dict[str, Any], at: tuple[float, float], expected: list[float]
) -> None:
    builder = GltfBuilder()
    texture = {"index": builder.texture(np.zeros((2, 2, 3), np.uint8))}
    texture |= {"extensions": {"KHR_texture_transform": transform}}
    shape = shape_of(plate_of({"baseColorTexture": texture}, builder), tmp_path)
    assert place(texture_of(shape), *at) == expected


def test_a_second_set_of_texture_coordinates(tmp_path: Path) -> None:
    builder = GltfBuilder()
    texture: dict[str, Any] = {"index": builder.texture(np.zeros((2, 2, 3), np.uint8)), "texCoord": 1}
    builder.plate(builder.material({"baseColorTexture": texture}), TEXCOORD_1=SQUARE_UV[[2, 3, 0, 1]])
    shape = shape_of(builder, tmp_path)
    assert shape.uv.tolist() == [[1, 1], [0, 1], [0, 0], [1, 0]]


def test_other_sets_are_a_fault_of_the_roles_that_need_them(tmp_path: Path) -> None:
    builder = GltfBuilder()
    color, rough = (builder.texture(np.zeros((2, 2, 3), np.uint8)) for _ in range(2))
    base = {"baseColorTexture": {"index": color}, "metallicRoughnessTexture": {"index": rough, "texCoord": 1}}
    builder.plate(builder.material(base, name="wood"), TEXCOORD_1=SQUARE_UV)
    (shape,) = content_of(builder, tmp_path).shapes
    assert shape.faults.keys() == {"roughness", "metallic"}
    assert "TEXCOORD_1" in shape.faults["roughness"].what
    assert "wood" in shape.faults["roughness"].what
    assert "base_color" in shape.values


@pytest.mark.parametrize(
    ("ior", "specular", "expected", "warned"),
    [
        # F0 = ((n - 1)/(n + 1))² c w is 0.08 times our `specular`.
        (1.33, {}, (0.33 / 2.33) ** 2 / 0.08, False),
        (0, {}, 12.5, False),
        (1.5, {"specularColorFactor": [1, 0, 0]}, 0.2126 * 0.5, True),
        (1.5, {"specularFactor": 0.25}, 0.125, True),
        # The product of color and F0 is 1 at most, before the weight.
        (0, {"specularColorFactor": [2, 2, 2], "specularFactor": 0.5}, 6.25, True),
    ],
)
def test_dielectrics(
    tmp_path: Path, ior: float, specular: dict[str, Any], expected: float, warned: bool
) -> None:
    extensions = {"KHR_materials_ior": {"ior": ior}, "KHR_materials_specular": specular}
    found = content_of(plate_of({"metallicFactor": 0}, extensions=extensions), tmp_path)
    assert found.shapes[0].values["specular"] == pytest.approx(expected, rel=1e-9)
    assert any("specular" in text for text in found.warnings) == warned


def test_vertex_colors_are_clamped_and_linear(tmp_path: Path) -> None:
    builder = GltfBuilder()
    codes = np.array([[0, 128, 255, 255]] * 4, np.uint8)
    builder.plate(COLOR_0=builder.accessor(codes, True))
    shape = shape_of(builder, tmp_path)
    assert shape.colors[0] == pytest.approx([0, 128 / 255, 1])
    builder = GltfBuilder().plate(COLOR_0=np.array([[2, -1, 0.5]] * 4, np.float32))
    found = content_of(builder, tmp_path)
    assert found.shapes[0].colors[0].tolist() == [1, 0, 0.5]
    assert any("clamped" in text for text in found.warnings)
