"""What the tile of a mesh makes of its materials: vertex colors, wrap modes, layers, companions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.gltf_files import SQUARE, GltfBuilder, png
from support.jobs import job_of
from support.scenes import mi

from mbtf_core.errors import InputError
from mbtf_core.meshes.content import MeshShape, Texture, numbers_of
from mbtf_gen.planning.run_plan import plan_effects, reference_plan
from mbtf_gen.tile.loading import latest_material, load_material
from mbtf_gen.tile.mesh_file import with_vertex_colors
from mbtf_gen.tile.mesh_tile import MeshTile
from mbtf_gen.tile.reflectance import plugin_dictionary

LAYERS = {
    "KHR_materials_clearcoat": {"clearcoatFactor": 0.5},
    "KHR_materials_sheen": {"sheenColorFactor": [0.5, 0, 0], "sheenRoughnessFactor": 0.5},
}


def tile_of(builder: GltfBuilder, folder: Path, yaml: str = "") -> MeshTile:
    builder.write(folder / "a.glb")
    (folder / "m.yaml").write_text(f"mesh: a.glb\nperiod: [1, 1]\n{yaml}")
    return load_material(folder / "m.yaml")


def looked_up(value: Any, uv: np.ndarray) -> np.ndarray:
    """Colors (n, 3) of texture coordinates (n, 2), v up, as Mitsuba looks them up."""
    texture = mi.load_dict(plugin_dictionary({"base_color": value})["base_color"])
    si = mi.SurfaceInteraction3f()
    si.uv = mi.Point2f(uv[:, 0], 1.0 - uv[:, 1])
    return np.array(texture.eval(si)).T


def test_varying_colors_of_vertices_are_interpolated_linearly() -> None:
    rng = np.random.default_rng(0)
    count = 7
    values = {"base_color": np.array([1.0, 0.5, 0.25])}
    faces = rng.integers(0, 9, (count, 3))
    shape = MeshShape("a", rng.random((9, 3)), faces, None, rng.random((9, 3)), values)
    found = with_vertex_colors(shape)
    weights = rng.dirichlet((1, 1, 1), 200)
    # Corners and points on edges as well.
    weights[:3], weights[3:6] = np.eye(3), (1 - np.eye(3)) / 2
    for t in range(count):
        assert found.vertices[found.faces[t]].tolist() == shape.vertices[shape.faces[t]].tolist()
        uv = weights @ found.uv[found.faces[t]]
        expected = weights @ shape.colors[shape.faces[t]] * (1, 0.5, 0.25)
        assert looked_up(found.values["base_color"], uv) == pytest.approx(expected, abs=2e-5)


def test_equal_colors_of_vertices_are_a_factor(tmp_path: Path) -> None:
    builder = GltfBuilder()
    texture = {"index": builder.texture(np.full((1, 1, 3), 255, np.uint8))}
    material = builder.material({"baseColorTexture": texture, "baseColorFactor": [0.5, 1, 1, 1]})
    builder.plate(material, COLOR_0=np.array([[0.5, 0.25, 1]] * 4, np.float32))
    found = numbers_of(tile_of(builder, tmp_path).parts[0].maps["base_color"])
    assert found[0, 0] == pytest.approx([0.25, 0.25, 1])
    builder.plate(material, COLOR_0=np.array([[0.5, 0.25, 1]] * 3 + [[0, 0, 0]], np.float32))
    with pytest.raises(InputError, match="colors"):
        tile_of(builder, tmp_path)


FOLDED = {
    "repeat": lambda x: x - np.floor(x),
    "mirror": lambda x: 1.0 - np.abs((x % 2.0) - 1.0),
    "clamp": lambda x: np.clip(x, 0.0, 1.0),
}


def texel(pixels: np.ndarray, u: np.ndarray, v: np.ndarray, mode: str) -> np.ndarray:
    """Bilinear look-up at (u, v), v up: the fold is that of texel numbers."""
    rows, columns = pixels.shape[:2]
    x, y = u * columns - 0.5, (1 - v) * rows - 0.5
    out = np.zeros((len(u), 3))
    for i in (0, 1):
        for j in (0, 1):
            column, row = np.floor(x) + i, np.floor(y) + j
            weight = (1 - np.abs(x - column)) * (1 - np.abs(y - row))
            number = []
            for index, size in ((column, columns), (row, rows)):
                folded = FOLDED[mode]((index + 0.5) / size) * size - 0.5
                number.append(np.clip(np.rint(folded), 0, size - 1).astype(int))
            out += weight[:, None] * pixels[number[1], number[0]]
    return out


@pytest.mark.parametrize("mode", FOLDED)
def test_wrap_modes(mode: Any) -> None:
    rng = np.random.default_rng(0)
    pixels = rng.random((3, 5, 3)).astype(np.float32)
    to_uv = np.array([[0.8, 0.3, 0.1], [-0.2, 1.1, 0.4]])
    value = (Texture(pixels, (mode, mode), False, to_uv), np.array([1.0, 0.5, 0.25]))
    uv = rng.uniform(-2, 3, (400, 2))
    x, y = (uv @ to_uv[:, :2].T + to_uv[:, 2]).T
    expected = texel(pixels, x, y, mode) * (1, 0.5, 0.25)
    assert looked_up(value, uv) == pytest.approx(expected, abs=1e-4)


def test_two_wrap_modes_of_a_texture_are_refused(tmp_path: Path) -> None:
    builder = GltfBuilder()
    texture = {"index": builder.texture(np.zeros((2, 2, 3), np.uint8), {"wrapT": 33071})}
    builder.plate(builder.material({"baseColorTexture": texture}))
    with pytest.raises(InputError, match="another wrap mode along u"):
        tile_of(builder, tmp_path)
    assert tile_of(builder, tmp_path, "base_color: 0.2\n").parts


def test_nearest_texels_are_not_interpolated() -> None:
    texture = Texture(np.array([[[0.0] * 3, [1.0] * 3]], np.float32), ("repeat", "repeat"), nearest=True)
    uv = np.array([[0.01, 0.5], [0.49, 0.5], [0.51, 0.5], [0.99, 0.5]])
    assert looked_up((texture, np.ones(3)), uv)[:, 0].tolist() == [0, 0, 1, 1]


def plans(tile: MeshTile, mode: str = "auto") -> tuple[set[str], set[str]]:
    """Reflections that a run and a reference picture simulate."""
    job = job_of(tile, mode)
    names = {"specular", "metallic", "clearcoat", "sheen"}
    return tuple(  # type: ignore[return-value]
        set(plan.names_on) & names for plan in (plan_effects(job, pilots=False), reference_plan(job))
    )


def test_effects_are_those_of_the_parts(tmp_path: Path) -> None:
    builder = GltfBuilder()
    builder.plate(builder.material({"metallicFactor": 0}))
    assert plans(tile_of(builder, tmp_path)) == ({"specular"}, {"specular"})
    # Another part has layers and metal.
    builder.plate(builder.material({}, extensions=LAYERS))
    tile = tile_of(builder, tmp_path)
    # The color of the sheen, 1/2 at most, counts.
    assert (tile.weight("metallic"), tile.weight("sheen")) == (1.0, 0.5)
    everything = {"specular", "metallic", "clearcoat", "sheen"}
    assert plans(tile) == (everything, everything)
    assert plans(tile, "-clearcoat")[0] == everything - {"clearcoat"}
    assert not tile.surface()[0].keys() & {"clearcoat", "sheen", "metallic"}
    assert "clearcoat" not in tile.surface(("specular", "sheen"))[1]
    # The coat is a mirror.
    assert tile.narrowest_lobe()[0] == 0.0


def test_a_fault_of_a_role_counts_unless_it_is_given(tmp_path: Path) -> None:
    builder = GltfBuilder()
    builder.add("images", {"uri": "gone.png"})
    builder.add("textures", {"source": 0})
    builder.plate(builder.material({"baseColorTexture": {"index": 0}, "metallicFactor": 0}))
    with pytest.raises(InputError, match="gone"):
        tile_of(builder, tmp_path)
    assert tile_of(builder, tmp_path, "base_color: 0.2\n").parts[0].maps["metallic"] == 0


def with_companions(folder: Path) -> Path:
    """A mesh of three files."""
    builder = GltfBuilder()
    builder.add("images", {"uri": "wood.png"})
    builder.add("textures", {"source": 0})
    builder.plate(builder.material({"baseColorTexture": {"index": 0}}))
    builder.node(builder.mesh(np.add(SQUARE, (0, 0.25, 0))))
    (folder / "wood.png").write_bytes(png(np.full((2, 2, 3), 128, np.uint8)))
    return builder.write(folder / "a.gltf")


@pytest.mark.parametrize("changed", ["wood.png", "a.bin", "a.gltf"])
def test_each_companion_is_part_of_the_material(tmp_path: Path, changed: str) -> None:
    path = with_companions(tmp_path)
    before = latest_material(path)
    assert before.files.keys() == {"mesh", "mesh.wood.png", "mesh.a.bin"}
    assert before.digests.keys() == {*before.files, "settings"}
    assert latest_material(path) is before
    content = (tmp_path / changed).read_bytes()
    content = png(np.full((2, 2, 3), 129, np.uint8)) if changed == "wood.png" else content + b" "
    (tmp_path / changed).write_bytes(content)
    after = latest_material(path)
    role = {"wood.png": "mesh.wood.png", "a.bin": "mesh.a.bin", "a.gltf": "mesh"}[changed]
    assert [name for name in before.digests if before.digests[name] != after.digests[name]] == [role]
