"""Maps of a known surface: closed forms, orientation, and the mean reflectance of the tile."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.known_surfaces import geometry
from support.plugin_materials import write_material

from mbtf_core.app.console import Console
from mbtf_core.data.lattice import Lattice
from mbtf_core.directions import from_angles
from mbtf_core.errors import UsageError
from mbtf_fit import Material, ops
from mbtf_fit.maps.maps import Maps, knows_surface, make_maps, scale_color, surface_maps
from mbtf_fit.maps.reference_values import direction_pairs, tile_means
from mbtf_fit.ops.constants import HEIGHTS
from mbtf_fit.pytorch.material import NeuralMaterial
from mbtf_fit.surface.known import KnownSurface


def known(folder: Path, **options: object) -> Material:
    """A material whose surface has these slopes, color, roughness and metallic everywhere."""
    lattice = Lattice(3, 1.0)
    surface = KnownSurface.of(geometry(lattice, np.zeros((8, 8), np.float32), **options), lattice, 0.0)  # type: ignore[arg-type]
    return write_material(folder, model="relief", glossy="roughness" in options, weights=surface.tensors())


def test_a_flat_lambert_tile_keeps_its_color(tmp_path: Path) -> None:
    """Its base color is π times its value."""
    value = (0.05, 0.1, 0.25)
    material = write_material(tmp_path, model="relief", constant=value)
    maps = scale_color(material, surface_maps(material, 3))
    expected = np.broadcast_to(math.pi * np.array(value), maps.base_color.shape)
    np.testing.assert_allclose(maps.base_color, expected, rtol=2e-3)
    np.testing.assert_allclose(surface_maps(material, 3).base_color, expected, rtol=2e-3)
    assert (maps.metallic == 0).all()
    assert (maps.roughness == 1).all()
    assert maps.dielectric == 0


def test_gaps_between_fibers_darken_hints_and_not_the_color(tmp_path: Path) -> None:
    lattice, color, covered = Lattice(3, 1.0), (0.6, 0.3, 0.2), 0.4
    plain = geometry(lattice, np.zeros((8, 8), np.float32), color=color)
    shape = plain.slopes.shape[:2]
    tangents = np.tile(np.array([covered, 0, 0, 0, 0, 0], np.float32), (*shape, 1))
    share = np.full(shape, covered, np.float32)
    fibers = {"tangent_moments": tangents, "longitudinal_variance": 0.1 * share, "opacity": share}
    surface = KnownSurface.of(replace(plain, **fibers), lattice, 0.0)
    material = write_material(tmp_path, model="cloth", glossy=False, weights=surface.tensors())
    base = material.model.weights()["surface.maps.3"][..., 5:8].numpy()
    np.testing.assert_allclose(base, np.broadcast_to(covered * np.array(color), base.shape), rtol=1e-4)
    found = surface_maps(material, 3).base_color
    np.testing.assert_allclose(found, np.broadcast_to(color, found.shape), rtol=1e-4)


def test_normals_and_roughness_are_those_of_the_surface(tmp_path: Path) -> None:
    material = known(tmp_path, slope=(0.5, -0.25), roughness=0.3, metallic=0.8)
    maps = surface_maps(material, 2)
    assert maps.roughness.shape == (4, 4)
    expected = np.array([-0.5, 0.25, 1]) / np.linalg.norm([-0.5, 0.25, 1])
    np.testing.assert_allclose(maps.normals, np.broadcast_to(expected, (4, 4, 3)), atol=1e-5)
    np.testing.assert_allclose(maps.roughness, 0.3, rtol=1e-4)
    np.testing.assert_allclose(maps.metallic, 0.8, rtol=1e-5)
    # A scatter of 0.16 along x.
    tensors = material.model.weights()
    tensors["surface.maps.2"][..., :5] = 0.0
    tensors["surface.maps.2"][..., 2] = 0.16
    material.model.load_weights(tensors)
    np.testing.assert_allclose(surface_maps(material, 2).roughness, (0.3**4 + 0.16) ** 0.25, rtol=1e-4)


def test_rows_and_opacity(tmp_path: Path) -> None:
    """Row 0 is that of the surface's maps; what passes through holes does not come back."""
    material = write_material(tmp_path, model="relief", aspect=0.5)
    maps, weights = surface_maps(material, material.lattice.finest), material.model.weights()
    stored = weights[f"surface.maps.{material.lattice.finest}"].double().numpy()
    np.testing.assert_array_equal(maps.base_color, np.clip(stored[..., 5:8], 0, 1))
    np.testing.assert_array_equal(maps.heights, weights["surface.heights"][..., 0].double().numpy())
    assert maps.heights is not None
    assert not np.array_equal(maps.heights, maps.heights[::-1])
    omega_i, omega_o = (from_angles(e, a)[None] for e, a in ((50.0, 20.0), (35.0, 160.0)))
    half = replace(maps, opacity=np.full_like(maps.roughness, 0.5))
    np.testing.assert_allclose(half.evaluate(omega_i, omega_o), 0.5 * maps.evaluate(omega_i, omega_o))


def test_surfaces_that_face_away_are_black() -> None:
    half, one = np.full((1, 1, 3), 0.5), np.ones((1, 1))
    maps = Maps(0, 1.0, half, np.array([[[3.0, 0.0]]]), 0.5 * one, 0 * one, one, 0.04, np.zeros((2, 2)))
    away, towards, up = from_angles(10.0, 0.0), from_angles(30.0, 180.0), np.array([0.0, 0.0, 1.0])
    lights, views = np.stack([away, up, towards]), np.stack([up, away, up])
    values = maps.evaluate(lights, views)[0]
    assert (values[:2] == 0).all()
    assert (values[2] > 0).all()


def test_the_mean_reflectance_is_that_of_the_network(tmp_path: Path) -> None:
    """With other lights and views than those of the fit, on a surface whose network differs from its maps."""
    material = write_material(tmp_path, model="relief", finest=4, brightness=0.0, contrast=0.2)
    maps = surface_maps(material, 4)
    light, view = direction_pairs(512, 0.1, seed=1)
    target = tile_means(material, light, view).mean(0)
    assert np.abs(maps.evaluate(light, view).mean((0, 1)) / target - 1).max() > 0.05
    scaled = scale_color(material, maps)
    np.testing.assert_allclose(scaled.evaluate(light, view).mean((0, 1)) / target, 1, rtol=0.06)


def test_levels_that_are_missing_are_refused(tmp_path: Path) -> None:
    assert not knows_surface(write_material(tmp_path / "neumip"))
    material = write_material(tmp_path / "relief", model="relief")
    assert knows_surface(material)
    # A surface that a model traces and does not shade has colors that are not the model's.
    traced = ops.Trace("z", "hit", "depth", "u", "level", "omega_o", HEIGHTS)
    model = NeuralMaterial(Lattice(3, 1.0), [traced, ops.Lookup("value", "hit", "level", "texels", 3)])
    assert not knows_surface(replace(material, model=model))
    assert make_maps(material, None, Console(quiet=True))[0].level == 3
    for level in (-1, 4):
        with pytest.raises(UsageError, match="has the levels 0 to 3"):
            make_maps(material, level, Console(quiet=True))


def test_a_clear_coat_at_its_peak(tmp_path: Path) -> None:
    """Along the normal D V = 1/(4πα²), the coat reflects 4% of its weight; the rest gets what is left."""
    maps = surface_maps(known(tmp_path, roughness=0.8, clearcoat=(0.6, 0.3)), 3)
    assert maps.coat is not None
    np.testing.assert_allclose(maps.coat, np.broadcast_to((0.6, 0.3), maps.coat.shape), rtol=1e-4)
    up = np.array([[0.0, 0.0, 1.0]])
    weight, roughness = maps.coat[0, 0]
    share = 0.04 * weight
    below = (1 - share) * replace(maps, coat=None).evaluate(up, up)
    expected = share / (4 * math.pi * roughness**4)
    np.testing.assert_allclose(maps.evaluate(up, up) - below, expected, rtol=1e-5)
