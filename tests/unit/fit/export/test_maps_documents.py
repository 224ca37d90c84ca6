"""Documents of glTF, USD and MaterialX, as the libraries of these formats read them."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from support.plugin_materials import write_material

from mbtf_core.app.console import run
from mbtf_core.color import srgb_to_linear
from mbtf_core.data.lattice import Lattice
from mbtf_fit.cli.app import app
from mbtf_fit.maps.maps import scale_color, surface_maps
from mbtf_fit.material.material import Material
from mbtf_fit.material.transmittance import Transmittance

FORMATS = ("gltf", "usd", "materialx")


def exported(folder: Path, **options: object) -> Path:
    """All documents of a material of half the height of its width."""
    write_material(folder / "material", model="relief", aspect=0.5, **options)  # type: ignore[arg-type]
    words = [word for name in FORMATS for word in ("--to", name)]
    assert run(app, ["export", str(folder / "material"), *words, "-o", str(folder / "out"), "-q"]) == 0
    return folder / "out"


@pytest.fixture(scope="module")
def glossy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Below a clear coat."""
    return exported(tmp_path_factory.mktemp("glossy"), coated=True)


def read_materialx(folder: Path) -> Any:
    """The document, valid against the library of MaterialX."""
    mx = pytest.importorskip("MaterialX")
    document, library = mx.createDocument(), mx.createDocument()
    mx.readFromXmlFile(document, str(folder / "material.mtlx"))
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
    document.importLibrary(library)
    assert document.validate() == (True, "")
    return document


def f0(out: Path) -> float:
    """Reflectance of the dielectric at normal incidence."""
    return float(Material.load(out.parent / "material").model.weights()["surface.dielectric"])


def f0_of(refractive: float) -> float:
    return ((refractive - 1) / (refractive + 1)) ** 2


def test_images_hold_the_maps(glossy: Path) -> None:
    maps = surface_maps(Material.load(glossy.parent / "material"), 3)
    normal = np.asarray(Image.open(glossy / "normal.png"), np.float64) / 255
    np.testing.assert_allclose(2 * normal - 1, maps.normals, atol=0.004)
    packed = np.asarray(Image.open(glossy / "roughness_metallic.png"), np.float64) / 255
    np.testing.assert_allclose(packed[..., 1], maps.roughness, atol=0.002)
    np.testing.assert_allclose(packed[..., 2], maps.metallic, atol=0.002)
    height = np.asarray(Image.open(glossy / "height.png"), np.float64) / 65535
    assert maps.heights is not None
    low = maps.heights.min()
    np.testing.assert_allclose(low + height * (maps.heights.max() - low), maps.heights, atol=1e-5)
    coat = np.asarray(Image.open(glossy / "clearcoat.png"), np.float64) / 255
    np.testing.assert_allclose(coat[..., :2], maps.coat, atol=0.002)
    image = Image.open(glossy / "base_color.png")
    assert image.mode == "RGB"
    # The fitted color, not that of the surface.
    fitted = scale_color(Material.load(glossy.parent / "material"), maps)
    color = srgb_to_linear(np.asarray(image, np.float64) / 255)
    np.testing.assert_allclose(color, fitted.base_color, atol=0.01)


VALIDATE = """
const [fs, path] = [require("fs"), require("path")], [file] = process.argv.slice(1);
const read = async (name) => new Uint8Array(fs.readFileSync(path.join(path.dirname(file), name)));
read(path.basename(file))
  .then((bytes) => require("gltf-validator").validateBytes(bytes, { externalResourceFunction: read }))
  .then((report) => console.log(JSON.stringify(report.issues.messages)));
"""


def test_gltf_is_valid_for_khronos(glossy: Path) -> None:
    if shutil.which("npm") is None:
        pytest.skip("no npm; to enable on Debian: apt-get install npm")
    modules = subprocess.run(["npm", "root", "-g"], check=True, capture_output=True, text=True).stdout.strip()
    if not (Path(modules) / "gltf-validator").is_dir():
        pytest.skip("no gltf-validator; to enable: npm install -g gltf-validator")
    command, environment = ["node", "-e", VALIDATE], os.environ | {"NODE_PATH": modules}
    for text, faults in ((glossy / "material.gltf").read_text(), 0), ("{}", 1):
        (glossy / "checked.gltf").write_text(text)
        found = subprocess.run(
            [*command, str(glossy / "checked.gltf")], check=True, capture_output=True, env=environment
        )
        assert len(json.loads(found.stdout)) == faults, found.stdout


def test_gltf(glossy: Path) -> None:
    pygltflib = pytest.importorskip("pygltflib")
    document = pygltflib.GLTF2().load(str(glossy / "material.gltf"))
    (material,) = document.materials
    uris = [image.uri for image in document.images]
    assert uris[material.pbrMetallicRoughness.baseColorTexture.index] == "base_color.png"
    assert uris[material.normalTexture.index] == "normal.png"
    packed = material.pbrMetallicRoughness.metallicRoughnessTexture
    assert uris[packed.index] == "roughness_metallic.png"
    coat = material.extensions["KHR_materials_clearcoat"]
    keys = ("clearcoatTexture", "clearcoatRoughnessTexture", "clearcoatNormalTexture")
    names = [uris[document.textures[coat[key]["index"]].source] for key in keys]
    assert names == ["clearcoat.png", "clearcoat.png", "normal.png"]
    assert (coat["clearcoatFactor"], coat["clearcoatRoughnessFactor"]) == (1, 1)
    assert f0_of(material.extensions["KHR_materials_ior"]["ior"]) == pytest.approx(f0(glossy), rel=1e-4)
    extras = material.extras
    description = json.loads((glossy / extras["neural_material"] / "material.json").read_text())
    assert extras["weights_sha256"] == description["weights"]["sha256"]
    data = base64.b64decode(document.buffers[0].uri.partition(",")[2])

    def array(name: int, kind: str, count: int) -> np.ndarray:
        view = document.bufferViews[document.accessors[name].bufferView]
        return np.frombuffer(data, kind, offset=view.byteOffset, count=count * document.accessors[name].count)

    positions, uv = array(0, "<f4", 3).reshape(-1, 3), array(3, "<f4", 2).reshape(-1, 2)
    assert positions.max(0).tolist() == [1, 0.5, 0]
    # Row 0 of an image, at 0 of the texture's second coordinate, is the tile's top.
    np.testing.assert_allclose(uv, np.stack([positions[:, 0], 1 - positions[:, 1] / 0.5], 1))
    triangles = positions[array(4, "<u2", 1).reshape(-1, 3)]
    up = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    assert (up[:, 2] > 0).all()
    normals, tangents = array(1, "<f4", 3).reshape(-1, 3), array(2, "<f4", 4).reshape(-1, 4)
    # The bitangent of glTF runs upwards in the image.
    np.testing.assert_allclose(
        np.cross(normals, tangents[:, :3]) * tangents[:, 3:], np.tile([0, 1, 0], (4, 1))
    )


def test_usd(glossy: Path) -> None:
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom, UsdShade, UsdValidation

    stage = Usd.Stage.Open(str(glossy / "material.usda"))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20
    assert UsdValidation.ValidationContext(validators).Validate(stage) == []
    mesh = stage.GetPrimAtPath("/Tile/Plane")
    bound, _ = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()
    surface = bound.ComputeSurfaceSource()[0]
    connections = {
        "diffuseColor": ("base_color.png", "rgb", "sRGB"),
        "normal": ("normal.png", "rgb", "raw"),
        "roughness": ("roughness_metallic.png", "g", "raw"),
        "metallic": ("roughness_metallic.png", "b", "raw"),
        "displacement": ("height.png", "r", "raw"),
        "clearcoat": ("clearcoat.png", "r", "raw"),
        "clearcoatRoughness": ("clearcoat.png", "g", "raw"),
    }
    for name, expected in connections.items():
        source, channel, _ = surface.GetInput(name).GetConnectedSource()
        texture = UsdShade.Shader(source.GetPrim())
        file = Path(texture.GetInput("file").Get().resolvedPath)
        assert (file.name, channel, texture.GetInput("sourceColorSpace").Get()) == expected
        assert texture.GetInput("wrapS").Get() == "repeat"
    points = np.array(UsdGeom.Mesh(mesh).GetPointsAttr().Get())
    st = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Get())
    # The origin of texture coordinates is at the lower left.
    np.testing.assert_allclose(st, points[:, :2] / (1, 0.5))
    normal = UsdShade.Shader(stage.GetPrimAtPath("/Tile/Material/normal"))
    assert normal.GetInput("scale").Get() == (2, 2, 2, 1)
    assert normal.GetInput("bias").Get() == (-1, -1, -1, 0)
    heights = surface_maps(Material.load(glossy.parent / "material"), 3).heights
    assert heights is not None
    height = UsdShade.Shader(stage.GetPrimAtPath("/Tile/Material/height"))
    assert height.GetInput("scale").Get()[0] == pytest.approx(np.ptp(heights), rel=1e-5)
    assert height.GetInput("bias").Get()[0] == pytest.approx(heights.min(), rel=1e-5)
    assert f0_of(surface.GetInput("ior").Get()) == pytest.approx(f0(glossy), rel=1e-4)


def test_materialx(glossy: Path) -> None:
    mx = pytest.importorskip("MaterialX")
    document = read_materialx(glossy)
    (material,) = document.getMaterialNodes()
    (surface,) = mx.getShaderNodes(material, "surfaceshader")
    assert f0_of(surface.getInput("ior").getValue()) == pytest.approx(f0(glossy), rel=1e-4)
    (moved,) = mx.getShaderNodes(material, "displacementshader")
    graph = document.getNodeGraph("maps")
    assert graph.getNode("base").getInput("file").getAttribute("colorspace") == "srgb_texture"
    channels = {"roughness": 1, "metallic": 2, "clearcoat": 0, "clearcoat_roughness": 1}
    for name, index in channels.items():
        assert surface.getInput(name).getConnectedOutput().getNodeName() == name
        assert graph.getNode(name).getInput("index").getValue() == index
    assert surface.getInput("clearcoat_normal").getConnectedOutput().getNodeName() == "normal"
    files = {"base": "base_color.png", "normal_image": "normal.png", "packed": "roughness_metallic.png"}
    for name, file in {**files, "height": "height.png", "coat": "clearcoat.png"}.items():
        assert graph.getNode(name).getInput("file").getValue() == file
    heights = surface_maps(Material.load(glossy.parent / "material"), 3).heights
    assert heights is not None
    scale, plane = moved.getInput("scale").getValue(), graph.getNode("below_plane")
    assert plane.getCategory() == "subtract"
    offset = plane.getInput("in2").getValue()
    # The values 0 and 1 of the image are the lowest and the highest vertex.
    extremes = [scale * (value - offset) for value in (0, 1)]
    np.testing.assert_allclose(extremes, [heights.min(), heights.max()], atol=1e-6)


def test_a_surface_without_gloss_with_holes(tmp_path: Path) -> None:
    lattice = Lattice(3, 0.5)
    levels = [np.zeros((*lattice.shape(s), 6), np.float32) for s in range(4)]
    for texels in levels:
        texels[0, :, 0] = 0.75
    out = exported(tmp_path, glossy=False, transmittance=Transmittance(lattice, (0.0,), [levels]))
    alpha = np.asarray(Image.open(out / "base_color.png"))[..., 3]
    assert alpha[0].tolist() == [64] * 8
    assert (alpha[1:] == 255).all()
    document = json.loads((out / "material.gltf").read_text())
    (material,) = document["materials"]
    assert material["alphaMode"] == "BLEND"
    assert material["extensions"] == {"KHR_materials_specular": {"specularFactor": 0.0}}
    assert "int inputs:useSpecularWorkflow = 1" in (out / "material.usda").read_text()
    mx = pytest.importorskip("MaterialX")
    read = read_materialx(out)
    (surface,) = mx.getShaderNodes(read.getMaterialNodes()[0], "surfaceshader")
    assert surface.getInput("specular").getValue() == 0
    assert surface.getInput("alpha_mode").getValue() == 2
