"""Materials of glTF files: factors, textures and their places, by numbers from the specification."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from support.gltf_files import SQUARE, SQUARE_UV, GltfBuilder, png

from mbtf_core.errors import InputError
from mbtf_core.meshes.content import MeshContent, MeshShape, Texture, numbers_of
from mbtf_core.meshes.read import read_mesh_content

# sRGB codes and their linear values (IEC 61966-2-1), to seven digits.
CODES = {0: 0.0, 10: 0.0030353, 128: 0.2158605, 200: 0.5775804, 255: 1.0}


def plate_of(base: dict[str, Any] | None, builder: GltfBuilder | None = None, **more: Any) -> GltfBuilder:
    builder = builder or GltfBuilder()
    return builder.plate(builder.material(base, **more))


def content_of(builder: GltfBuilder, folder: Path) -> MeshContent:
    return read_mesh_content(builder.write(folder / "a.glb"))


def shape_of(builder: GltfBuilder, folder: Path) -> MeshShape:
    (shape,) = content_of(builder, folder).shapes
    assert shape.faults == {}
    return shape


def numbers(shape: MeshShape, role: str) -> list[Any]:
    return np.round(numbers_of(shape.values[role]).astype(np.float64), 6).tolist()


def texture_of(shape: MeshShape, role: str = "base_color") -> Texture:
    value = shape.values[role]
    assert isinstance(value, tuple)
    return value[0]


@pytest.mark.parametrize("material", [None, {}, {"name": "x"}])
def test_absent_factors_are_one(tmp_path: Path, material: dict[str, Any] | None) -> None:
    builder = GltfBuilder()
    builder.plate(None if material is None else builder.add("materials", material))
    shape = shape_of(builder, tmp_path)
    assert numbers(shape, "base_color") == [1, 1, 1]
    assert (shape.values["roughness"], shape.values["metallic"]) == (1, 1)
    # An index of refraction of 1.5 reflects 4 %, half of what `specular` 1 does.
    assert shape.values.keys() == {"base_color", "roughness", "metallic", "specular"}
    assert numbers(shape, "specular") == 0.5


def test_base_colors_are_srgb_times_the_factor(tmp_path: Path) -> None:
    builder = GltfBuilder()
    pixels = np.array([[[0, 10, 128], [200, 255, 255]]], np.uint8)
    base = {"baseColorTexture": {"index": builder.texture(pixels)}, "baseColorFactor": [1, 1, 0.5, 1]}
    expected = [[[0, CODES[10], CODES[128] / 2], [CODES[200], 1, 0.5]]]
    assert numbers_of(shape_of(plate_of(base, builder), tmp_path).values["base_color"]) == pytest.approx(
        np.array(expected), abs=1e-6
    )


def test_channels_of_metallic_and_roughness_are_linear(tmp_path: Path) -> None:
    builder = GltfBuilder()
    deep = builder.texture(np.array([[[65535, 13107, 26214]]], np.uint16))
    gray = builder.texture(np.array([[128]], np.uint8))
    base = {"metallicRoughnessTexture": {"index": deep}, "roughnessFactor": 0.5}
    shape = shape_of(plate_of({**base, "baseColorTexture": {"index": gray}}, builder), tmp_path)
    assert numbers(shape, "roughness") == [[0.1]]
    assert numbers(shape, "metallic") == [[0.4]]
    assert numbers_of(shape.values["base_color"]) == pytest.approx(np.full((1, 1, 3), CODES[128]), abs=1e-6)


def test_jpeg_files_beside_it_are_read_whatever_their_name(tmp_path: Path) -> None:
    pixels = np.full((8, 8, 3), (200, 10, 128), np.uint8)
    Image.fromarray(pixels).save(tmp_path / "wood a.png", "JPEG", quality=100, subsampling=0)
    builder = GltfBuilder()
    builder.add("images", {"uri": "wood%20a.png"})
    base = {"baseColorTexture": {"index": builder.add("textures", {"source": 0})}}
    found = content_of(plate_of(base, builder), tmp_path)
    assert found.files == {"wood%20a.png": tmp_path / "wood a.png"}
    expected = [CODES[200], CODES[10], CODES[128]]
    assert numbers_of(found.shapes[0].values["base_color"])[0, 0] == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize(
    ("codes", "wrap"), [(10497, "repeat"), (33648, "mirror"), (33071, "clamp"), (None, "repeat")]
)
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
        ({"scale": [4, 4], "offset": [0.125, 0]}, (0.25, 0.5), [1.125, 2.0]),
        ({"offset": [0, 1], "scale": [1, -1]}, (0.2, 0.3), [0.2, 0.7]),
        # The example of the extension: the lower left quarter of the image, turned clockwise.
        ({"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]}, (0, 0), [0, 1]),
        ({"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]}, (1, 0), [0, 0.5]),
        ({"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]}, (0, 1), [0.5, 1]),
        # Scaled before it is turned.
        ({"rotation": np.pi / 2, "scale": [2, 3]}, (1, 0), [0, -2]),
        ({"rotation": np.pi / 2, "scale": [2, 3]}, (0, 1), [3, 0]),
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


@pytest.mark.parametrize("by", ["texCoord", "transform"])
def test_a_second_set_of_texture_coordinates(tmp_path: Path, by: str) -> None:
    builder = GltfBuilder()
    texture: dict[str, Any] = {"index": builder.texture(np.zeros((2, 2, 3), np.uint8)), "texCoord": 1}
    if by == "transform":
        texture |= {"texCoord": 0, "extensions": {"KHR_texture_transform": {"texCoord": 1}}}
    builder.plate(builder.material({"baseColorTexture": texture}), TEXCOORD_1=SQUARE_UV[[2, 3, 0, 1]])
    shape = shape_of(builder, tmp_path)
    assert shape.uv is not None
    assert shape.uv.tolist() == [[1, 1], [0, 1], [0, 0], [1, 0]]


def two_sets(second: np.ndarray) -> GltfBuilder:
    builder = GltfBuilder()
    color, rough = (builder.texture(np.zeros((2, 2, 3), np.uint8)) for _ in range(2))
    base = {
        "baseColorTexture": {"index": color},
        "metallicRoughnessTexture": {"index": rough, "texCoord": 1},
    }
    return builder.plate(builder.material(base, name="wood"), TEXCOORD_1=second.astype(np.float32))


def test_sets_that_follow_from_each_other_are_one(tmp_path: Path) -> None:
    shape = shape_of(two_sets(SQUARE_UV * 3 + (0.5, -1)), tmp_path)
    assert place(texture_of(shape), 0.2, 0.7) == [0.2, 0.7]
    assert place(texture_of(shape, "roughness"), 0.2, 0.7) == [1.1, 1.1]


def test_independent_sets_are_a_fault_of_the_roles_that_need_them(tmp_path: Path) -> None:
    (shape,) = content_of(two_sets(SQUARE_UV**2 + SQUARE_UV[[1, 1, 0, 3]]), tmp_path).shapes
    assert shape.faults.keys() == {"roughness", "metallic"}
    assert "TEXCOORD_1" in shape.faults["roughness"].what
    assert "wood" in shape.faults["roughness"].what
    assert "base_color" in shape.values


def test_a_part_without_texture_coordinates_is_a_fault(tmp_path: Path) -> None:
    builder = GltfBuilder()
    base = {"baseColorTexture": {"index": builder.texture(np.zeros((2, 2, 3), np.uint8))}}
    material = builder.material(base)
    builder.plate(material)
    builder.node(builder.mesh(SQUARE, material=material))
    first, second = content_of(builder, tmp_path).shapes
    assert first.faults == {}
    assert second.faults.keys() == {"base_color"}


def test_layers_have_their_channels(tmp_path: Path) -> None:
    builder = GltfBuilder()
    texture = {"index": builder.texture(np.array([[[51, 102, 153, 204]]], np.uint8))}
    clearcoat = {
        "clearcoatFactor": 0.5,
        "clearcoatTexture": texture,
        "clearcoatRoughnessFactor": 0.25,
        "clearcoatRoughnessTexture": texture,
    }
    sheen = {
        "sheenColorFactor": [1, 0.5, 0],
        "sheenColorTexture": {"index": builder.texture(np.array([[[128, 128, 255]]], np.uint8))},
        "sheenRoughnessFactor": 0.5,
        "sheenRoughnessTexture": texture,
    }
    extensions = {"KHR_materials_clearcoat": clearcoat, "KHR_materials_sheen": sheen}
    shape = shape_of(plate_of({}, builder, extensions=extensions), tmp_path)
    assert numbers(shape, "clearcoat") == [[0.1]]
    assert numbers(shape, "clearcoat_roughness") == [[0.1]]
    assert numbers(shape, "sheen") == 1.0
    assert numbers_of(shape.values["sheen_color"])[0, 0] == pytest.approx([CODES[128], CODES[128] / 2, 0])
    assert numbers(shape, "sheen_roughness") == [[0.4]]


def test_layers_of_zero_weight_are_none_and_a_bare_clear_coat_is_smooth(tmp_path: Path) -> None:
    extensions: dict[str, Any] = {"KHR_materials_clearcoat": {}, "KHR_materials_sheen": {}}
    shape = shape_of(plate_of({}, extensions=extensions), tmp_path)
    assert not shape.values.keys() & {"clearcoat", "sheen"}
    extensions["KHR_materials_clearcoat"] = {"clearcoatFactor": 1}
    shape = shape_of(plate_of({}, extensions=extensions), tmp_path)
    assert (shape.values["clearcoat"], shape.values["clearcoat_roughness"]) == (1, 0)


@pytest.mark.parametrize(
    ("ior", "specular", "expected", "warned"),
    [
        # F0 = ((n - 1)/(n + 1))² c w is 0.08 times our `specular`.
        (1.33, {}, (0.33 / 2.33) ** 2 / 0.08, False),
        (2.42, {}, (1.42 / 3.42) ** 2 / 0.08, False),
        (0, {}, 12.5, False),
        (1.5, {"specularColorFactor": [2, 2, 2]}, 1.0, False),
        (1.5, {"specularColorFactor": [1, 0, 0]}, 0.2126 * 0.5, True),
        (1.5, {"specularFactor": 0.25}, 0.125, True),
        (1.0, {}, 0.0, True),
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


def test_textures_of_the_specular_lobe(tmp_path: Path) -> None:
    builder = GltfBuilder()
    texture = {"index": builder.texture(np.array([[[128, 128, 128, 51]]], np.uint8))}
    for key, expected in (("specularTexture", 0.5 * 0.2), ("specularColorTexture", 0.5 * CODES[128])):
        extensions = {"KHR_materials_specular": {key: texture}}
        builder.document.pop("nodes", None)
        shape = shape_of(plate_of({"metallicFactor": 0}, builder, extensions=extensions), tmp_path)
        assert numbers_of(shape.values["specular"]) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    ("mode", "alphas", "factor", "expected"),
    [
        ("OPAQUE", [0, 255], 0.5, None),
        ("BLEND", [51, 255], 0.5, [[0.1, 0.5]]),
        ("BLEND", [255, 255], 1.0, None),
        ("MASK", [0, 255], 1.0, [[0.0, 1.0]]),
        # All of it is above the cutoff of 0.5.
        ("MASK", [204, 255], 1.0, None),
    ],
)
def test_alpha(
    tmp_path: Path, mode: str, alphas: list[int], factor: float, expected: list[list[float]] | None
) -> None:
    builder = GltfBuilder()
    pixels = np.full((1, 2, 4), 255, np.uint8)
    pixels[0, :, 3] = alphas
    base = {"baseColorTexture": {"index": builder.texture(pixels)}, "baseColorFactor": [1, 1, 1, factor]}
    shape = shape_of(plate_of(base, builder, alphaMode=mode), tmp_path)
    assert (numbers(shape, "opacity") if "opacity" in shape.values else None) == expected
    assert shape.values.get("opacity_cutoff") == (0.5 if mode == "MASK" and expected else None)


def test_images_without_alpha_are_opaque(tmp_path: Path) -> None:
    builder = GltfBuilder()
    texture = {"index": builder.texture(np.full((1, 1, 3), 51, np.uint8))}
    base = {"baseColorTexture": texture, "baseColorFactor": [1, 1, 1, 0.5]}
    assert numbers(shape_of(plate_of(base, builder, alphaMode="BLEND"), tmp_path), "opacity") == [[0.5]]


def test_vertex_colors_are_clamped_and_linear(tmp_path: Path) -> None:
    builder = GltfBuilder()
    codes = np.array([[0, 128, 255, 255]] * 4, np.uint8)
    builder.plate(COLOR_0=builder.accessor(codes, True))
    shape = shape_of(builder, tmp_path)
    assert shape.colors is not None
    assert shape.colors[0] == pytest.approx([0, 128 / 255, 1])
    builder = GltfBuilder().plate(COLOR_0=np.array([[2, -1, 0.5]] * 4, np.float32))
    found = content_of(builder, tmp_path)
    assert found.shapes[0].colors is not None
    assert found.shapes[0].colors[0].tolist() == [1, 0, 0.5]
    assert any("clamped" in text for text in found.warnings)
    with pytest.raises(InputError, match="normalized"):
        content_of(GltfBuilder().plate(COLOR_0=codes), tmp_path)


def test_alpha_of_vertices_is_refused_where_it_counts(tmp_path: Path) -> None:
    for mode in ("OPAQUE", "BLEND"):
        builder = GltfBuilder()
        builder.plate(builder.material(alphaMode=mode), COLOR_0=np.full((4, 4), 0.5, np.float32))
        if mode == "OPAQUE":
            assert "opacity" not in shape_of(builder, tmp_path).values
        else:
            with pytest.raises(InputError, match="alpha"):
                content_of(builder, tmp_path)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("metallicFactor", 1e9),
        ("metallicFactor", -0.1),
        ("roughnessFactor", "0.5"),
        ("roughnessFactor", True),
        ("baseColorFactor", [1, 1, 1]),
        ("baseColorFactor", [-1, 1, 1, 1]),
        ("baseColorFactor", [1, 1, 1, 2]),
    ],
)
def test_factors_out_of_range_are_refused(tmp_path: Path, key: str, value: Any) -> None:
    with pytest.raises(InputError, match=f"materials.0.pbrMetallicRoughness.{key}"):
        content_of(plate_of({key: value}), tmp_path)
    path = plate_of({"metallicFactor": 0.25}).write(tmp_path / "a.gltf")
    path.write_text(path.read_text().replace("0.25", "NaN"))
    with pytest.raises(InputError, match="NaN"):
        read_mesh_content(path)


UNUSED = {
    "normal": {"normalTexture": {"index": 0}},
    "occlusion": {"occlusionTexture": {"index": 0}},
    "emission": {"emissiveFactor": [0, 0, 2]},
    "KHR_materials_unlit": {"extensions": {"KHR_materials_unlit": {}}},
    "KHR_materials_transmission": {"extensions": {"KHR_materials_transmission": {}}},
    "normal textures": {"extensions": {"KHR_materials_clearcoat": {"clearcoatNormalTexture": {"index": 0}}}},
}


@pytest.mark.parametrize("word", UNUSED)
def test_what_is_not_used_is_named_once(tmp_path: Path, word: str) -> None:
    builder = GltfBuilder()
    for name in "ab":
        builder.plate(builder.material({}, name=name, **UNUSED[word]))
    (text,) = content_of(builder, tmp_path).warnings
    assert word in text


def fault_of(texture: dict[str, Any], image: dict[str, Any] | None, folder: Path) -> InputError:
    builder = GltfBuilder()
    if image is not None:
        builder.add("images", image)
    builder.add("textures", texture)
    (shape,) = content_of(plate_of({"baseColorTexture": {"index": 0}}, builder), folder).shapes
    assert shape.faults.keys() == {"base_color"}
    return shape.faults["base_color"]


def test_images_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    fault = fault_of({"source": 0}, {"uri": "gone.png"}, tmp_path)
    assert fault.where == str(tmp_path / "gone.png")
    (tmp_path / "a.png").write_bytes(png(np.zeros((4, 4, 3), np.uint8))[:40])
    assert fault_of({"source": 0}, {"uri": "a.png"}, tmp_path).where == str(tmp_path / "a.png")
    (tmp_path / "b.png").write_bytes(b"\xabKTX 20\xbb\r\n\x1a\n" + bytes(99))
    assert fault_of({"source": 0}, {"uri": "b.png"}, tmp_path).where == str(tmp_path / "b.png")
    assert "KTX2" in fault_of({"extensions": {"KHR_texture_basisu": {"source": 0}}}, None, tmp_path).hint
    assert "no image" in fault_of({}, None, tmp_path).what
    assert "images.3" in fault_of({"source": 3}, None, tmp_path).what


def test_the_fallback_of_another_format_is_used(tmp_path: Path) -> None:
    builder = GltfBuilder()
    builder.texture(np.full((1, 1, 3), 255, np.uint8))
    builder.document["textures"][0]["extensions"] = {"EXT_texture_webp": {"source": 5}}
    found = content_of(plate_of({"baseColorTexture": {"index": 0}}, builder), tmp_path)
    assert found.shapes[0].faults == {}
    assert any("webp" in text for text in found.warnings)


def test_specular_and_glossiness_alone_are_a_fault(tmp_path: Path) -> None:
    extensions = {"KHR_materials_pbrSpecularGlossiness": {"diffuseFactor": [1, 0, 0, 1]}}
    (shape,) = content_of(plate_of(None, extensions=extensions), tmp_path).shapes
    assert shape.faults.keys() == {"base_color", "roughness", "metallic"}
    found = content_of(plate_of({}, extensions=extensions), tmp_path)
    assert found.shapes[0].faults == {}
    assert any("SpecularGlossiness" in text for text in found.warnings)
