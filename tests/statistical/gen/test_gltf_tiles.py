"""Tiles of glTF files against a block of the same tiles in unmodified Mitsuba, and against closed forms."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.gltf_files import SQUARE, SQUARE_UV, GltfBuilder
from support.mitsuba_blocks import SPP, instances, mitsuba_halves, random_queries
from support.scenes import (
    Estimator,
    LightKernel,
    Stream,
    Transport,
    build_scene,
    direction,
    directional,
    mi,
    queries,
    tile_mean_queries,
)
from support.significance import aggregate_test

from mbtf_core.stats import elevation_groups, mean_of_halves
from mbtf_gen.render.scene import LONG_SIDE
from mbtf_gen.tile.loading import load_material
from mbtf_gen.tile.mesh_tile import MeshTile

# Reflects nothing but its base color: an index of refraction of one.
LAMBERT = {"KHR_materials_ior": {"ior": 1.0}}
GOLD = (1.0, 0.766, 0.336)
# Places (x, z), angles about y and sizes of fins; some reach over the border.
FINS = np.array(
    [[0.2, -0.3, 0.4, 0.1], [0.9, -0.5, 1.9, 0.2], [0.5, -0.9, 2.9, 0.16], [0.4, -0.55, 5.1, 0.12]]
)
DEPTH = 0.3
TURN, SCALE, OFFSET = 0.5, (1.5, 2.5), (0.1, 0.2)


def load(builder: GltfBuilder, folder: Path) -> MeshTile:
    builder.write(folder / "a.glb")
    (folder / "material.yaml").write_text("mesh: a.glb\nperiod: [1, 1]\n")
    tile = load_material(folder)
    return tile


def estimated(tile: MeshTile, light: LightKernel, q: Any, spp: int, **transport: Any) -> Any:
    estimator = Estimator(build_scene(tile, tile.surface()), light, Transport(**transport))
    return estimator.estimate(q, spp, Stream(5, "test", 0))


def ply(path: Path, vertices: NDArray[Any], uv: NDArray[Any], bsdf: dict[str, Any]) -> dict[str, Any]:
    """A shape of Mitsuba: squares of four vertices in glTF's axes, texture coordinates v down."""
    z_up = vertices[:, [0, 2, 1]] * (1, -1, 1) - (0.5, 0.5, 0.0)
    rows = np.column_stack([z_up * LONG_SIDE, uv])
    count = len(rows) // 4
    names = "".join(f"property float {name}\n" for name in "xyzuv")
    path.write_text(
        f"ply\nformat ascii 1.0\nelement vertex {len(rows)}\n{names}element face {2 * count}\n"
        "property list uchar int vertex_indices\nend_header\n"
        + "".join(" ".join(f"{x:.9g}" for x in row) + "\n" for row in rows)
        + "".join(f"3 {a} {a + 1} {a + 2}\n3 {a} {a + 2} {a + 3}\n" for a in range(0, 4 * count, 4))
    )
    both = {"type": "twosided", "nested": bsdf}
    return {"type": "ply", "filename": str(path), "face_normals": True, "bsdf": both}


def bitmap(pixels: NDArray[Any], wrap: str) -> dict[str, Any]:
    image = mi.Bitmap(np.ascontiguousarray(pixels, np.float32))
    return {"type": "bitmap", "bitmap": image, "raw": True, "wrap_mode": wrap}


def test_mitsuba_agrees_on_a_file_of_many_features(tmp_path: Path) -> None:
    """A floor of turned, mirrored, second texture coordinates; quantized golden fins of several nodes."""
    rng = np.random.default_rng(3)
    codes, gloss = rng.integers(0, 256, (4, 5, 3), np.uint8), rng.integers(60, 160, (3, 2, 3), np.uint8)
    builder = GltfBuilder()
    transform = {"rotation": TURN, "scale": SCALE, "offset": OFFSET, "texCoord": 1}
    color = builder.texture(codes, {"wrapS": 33648, "wrapT": 33648})
    texture = {"index": color, "extensions": {"KHR_texture_transform": transform}}
    floor = builder.material({"baseColorTexture": texture, "metallicFactor": 0}, extensions=LAMBERT)
    uv = np.rint(SQUARE_UV[[1, 2, 3, 0]] * 60000).astype(np.uint16)
    mesh = builder.mesh(
        material=floor, TEXCOORD_0=SQUARE_UV * 7, TEXCOORD_1=builder.accessor(uv, normalized=True)
    )
    builder.node(mesh)
    rough = {"index": builder.texture(gloss)}
    gold = builder.material({"baseColorFactor": [*GOLD, 1], "metallicRoughnessTexture": rough})
    # A fin leans: its lower edge along x, its upper edge moved along z.
    fin = np.array([[-1, 0, -1], [1, 0, -1], [1, 1, 1], [-1, 1, 1]])
    positions = builder.accessor(np.rint(fin * 32767).astype(np.int16), normalized=True)
    mesh = builder.mesh(positions, material=gold, TEXCOORD_0=SQUARE_UV)
    quaternions = np.zeros((len(FINS), 4))
    quaternions[:, 1], quaternions[:, 3] = np.sin(FINS[:, 2] / 2), np.cos(FINS[:, 2] / 2)
    turned = np.rint(quaternions * 127).astype(np.int8)
    for (x, z, _, size), rotation in zip(FINS, turned / 127, strict=True):
        scale = [size, DEPTH - 0.05, size / 3]
        builder.node(mesh, translation=[x, 0.05, z], rotation=rotation.tolist(), scale=scale)
    tile = load(builder, tmp_path)
    assert tile.vertices[:, 0].max() > 1.02

    # The same by hand. The highest point is at z = 0.
    c, s = np.cos(TURN), np.sin(TURN)
    placed = (uv / 65535 * SCALE) @ np.array([[c, s], [-s, c]]).T + OFFSET
    stored = codes / 255.0
    linear = np.where(stored <= 0.04045, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4)
    angles = 2 * np.arctan2(turned[:, 1].astype(float), turned[:, 3])
    fins = []
    for (x, z, _, size), angle in zip(FINS, angles, strict=True):
        a, b, d = (fin * (size, DEPTH - 0.05, size / 3)).T
        turned_fin = [a * np.cos(angle) + d * np.sin(angle), b, -a * np.sin(angle) + d * np.cos(angle)]
        fins.append(np.add(np.column_stack(turned_fin), (x, 0.05, z)))
    green, blue = (gloss[..., k : k + 1] / 255.0 for k in (1, 2))
    metal = {"type": "mbtf_surface", "base_color": {"type": "rgb", "value": list(GOLD)}, "specular": 0.5}
    metal |= {"roughness": bitmap(green, "repeat"), "metallic": bitmap(blue, "repeat")}
    diffuse = {"type": "diffuse", "reflectance": bitmap(linear, "mirror")}
    down = np.array([0, DEPTH, 0])
    plates = ply(tmp_path / "fins.ply", np.vstack(fins) - down, np.tile(SQUARE_UV, (len(FINS), 1)), metal)
    floor = ply(tmp_path / "floor.ply", SQUARE - down, placed, diffuse)
    scene: dict[str, Any] = {"group": {"type": "shapegroup", "floor": floor, "fins": plates}}
    scene |= instances(LONG_SIDE, LONG_SIDE)
    omega_i = direction(40, 70)
    q = random_queries(4096, 0.01, omega_i)
    a, b = mitsuba_halves(scene, directional(omega_i), q, 1.0, 3)
    ours = estimated(tile, LightKernel(0.0), q, SPP, max_depth=2, roulette_depth=1000)
    groups = elevation_groups(q.omega_o, edges=(0.0, 0.8, 1.0))
    result = aggregate_test(ours.value_a, ours.value_b, a, b, groups)
    # As in test_mitsuba_agreement: Mitsuba's rays start farther above the surface.
    mean = float(ours.value_a.mean())
    allowed = {"mean": 2e-3 * mean, "scatter": 2e-3 * mean**2}
    for comparison in result.comparisons:
        fits = abs(comparison.estimate.value) < allowed[comparison.kind]
        assert comparison.corrected > 1e-3 or fits, str(result)
    assert mean > 0.02


@pytest.mark.parametrize(("mode", "share"), [("MASK", 0.5), ("BLEND", 0.4)])
def test_holes_of_a_plate_are_the_transmittance(mode: str, share: float, tmp_path: Path) -> None:
    """Alpha rises from 0 to 1 along u, mirrored; half of it is above the cutoff. Constant alpha blends."""
    pixels = np.full((1, 2, 4), 255, np.uint8)
    pixels[0, 0, 3] = 0
    builder = GltfBuilder()
    base: dict[str, Any] = {"metallicFactor": 0, "baseColorFactor": [0.5, 0.5, 0.5, share]}
    if mode == "MASK":
        base |= {"baseColorTexture": {"index": builder.texture(pixels)}}
        base["baseColorFactor"][3] = 1
    builder.plate(builder.material(base, alphaMode=mode, extensions=LAMBERT))
    # A second part, below all holes, of which the tile mean shows what the holes let through.
    black = builder.material({"baseColorFactor": [0, 0, 0, 1]})
    builder.node(builder.mesh(SQUARE * (0.5, 1, 1), material=black))
    builder.document["nodes"][1]["translation"] = [0, -0.01, 0]
    tile = load(builder, tmp_path)
    up = np.array([0.0, 0.0, 1.0])
    e = estimated(tile, LightKernel(0.0), tile_mean_queries(direction(50, 90), up, 4000), 16)
    found = mean_of_halves(e.value_a[:, 0], e.value_b[:, 0])
    assert abs(found.value - share * 0.5 / np.pi) < 4 * found.error < 0.004
    # The black half below stops what passes there, which is all of the cut one.
    passed = 0.0 if mode == "MASK" else (1 - share) / 2
    assert e.transmittance.mean() == pytest.approx(passed, abs=4 * 0.5 / np.sqrt(16 * 4000))
    if mode == "MASK":
        u = np.array([[0.1, 0.5], [0.27, 0.5], [0.73, 0.5], [0.9, 0.5]])
        e = estimated(tile, LightKernel(0.0), queries(u, 1e-4, direction(50, 90), up, 4), 4)
        assert (e.value_a[:, 0] > 0.1).tolist() == [False, False, True, True]
