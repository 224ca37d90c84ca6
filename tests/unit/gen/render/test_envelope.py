"""What fibers and meshes show from above: profiles, directions, colors, gaps and holes in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.scenes import mi

from mbtf_core.data.geometry import Geometry
from mbtf_gen.render.envelope import _Half, seen_from_above
from mbtf_gen.render.scene import build_scene
from mbtf_gen.tile.fiber_tile import FiberScattering, FiberTile
from mbtf_gen.tile.fibers.curves import Curve
from mbtf_gen.tile.mesh_tile import MeshPart, MeshTile
from mbtf_gen.tile.protocol import REFLECTION

assert mi
COLORS = np.array([[0.2, 0.4, 0.6], [0.8, 0.1, 0.3]])
RADIUS, ASPECT, FINEST = 0.06, 0.5, 4


def wire(slope: tuple[float, float, float], y: float, z: float) -> Curve:
    """A straight closed curve from x = 0 to 1, which starts at (0, y, z)."""
    shift = np.array([1.0, slope[1], 0.0])
    points = np.array([0.0, y, z]) + np.arange(8)[:, None] / 8 * np.asarray(slope)
    return Curve.through(points, RADIUS, shift)


def seen(*curves: Curve) -> Geometry:
    yarn = np.arange(len(curves)) % 2
    scattering = FiberScattering(roughness=0.2), FiberScattering(roughness=0.5)
    tile = FiberTile.settled(ASPECT, curves, yarn, COLORS, scattering)
    return seen_from_above(tile, FINEST, ("transmission",))


def test_a_straight_wire_has_its_profile_direction_and_color() -> None:
    low = wire((1.0, 0.0, 0.0), 0.125, -0.1)
    found = seen(wire((1.0, 0.0, 0.0), 0.375, 0.0), low)
    rows, columns = found.heights.shape
    assert (rows, columns) == (64, 128)
    y = (1 - (np.arange(rows) + 0.5) / rows) * ASPECT
    inside = np.abs(y - 0.375) < 0.9 * RADIUS
    top = np.sqrt(np.maximum(RADIUS**2 - (y - 0.375) ** 2, 0.0))
    # The highest ray starts half a texel from the ridge.
    wanted = np.repeat((top - top.max())[inside, None], columns, axis=1)
    np.testing.assert_allclose(found.heights[inside], wanted, atol=1e-5)
    assert found.heights[np.abs(y - 0.25) < 0.02].max() == pytest.approx(-0.1 - 2 * RADIUS, abs=0.005)
    # Maps: 16 x 32 texels of 1/32; fibers cover their diameter, and lie along x.
    coverage = found.opacity
    assert coverage.shape == (16, 32)
    # Four borders, to half a row of rays each.
    assert coverage.mean() == pytest.approx(2 * 2 * RADIUS / ASPECT, abs=4 * 0.5 / rows)
    np.testing.assert_allclose(found.tangent_moments[..., 0], coverage, atol=1e-5)
    np.testing.assert_allclose(found.tangent_moments[..., 1:], 0.0, atol=1e-5)
    upper, lower = coverage[4], coverage[12]
    assert upper.min() == lower.min() == 1.0
    np.testing.assert_allclose(found.base_color[4, 0], COLORS[0], atol=1e-6)
    np.testing.assert_allclose(found.base_color[12, 0], COLORS[1], atol=1e-6)
    narrow, wide = (FiberScattering(roughness=r).longitudinal_variance for r in (0.2, 0.5))
    np.testing.assert_allclose(found.longitudinal_variance[[4, 12], 0], [narrow, wide], rtol=1e-5)
    # Chiang et al. 2016, equation 7.
    assert narrow == pytest.approx((0.726 * 0.2 + 0.812 * 0.04) ** 2, rel=1e-6)


def test_diagonal_and_rising_fibers_keep_their_signs() -> None:
    diagonal = seen(wire((1.0, ASPECT, 0.0), 0.0, 0.0)).tangent_moments
    t = np.array([1.0, ASPECT]) / np.hypot(1.0, ASPECT)
    covered = diagonal[..., [0, 3, 5]].sum(-1) > 0.999
    found = diagonal[covered][:, [0, 1, 3]].mean(0)
    np.testing.assert_allclose(found, [t[0] ** 2, t[0] * t[1], t[1] ** 2], atol=1e-3)
    # An arch rises in the first half of the tile, and falls in the second.
    x = np.arange(16) / 16
    arch = np.column_stack([x, np.full(16, 0.25), 0.1 * np.sin(2 * np.pi * (x - 0.25))])
    rising = seen(Curve.through(arch, RADIUS, np.array([1.0, 0.0, 0.0]))).tangent_moments[8, :, 2]
    assert rising[4:12].min() > 0.1
    assert rising[20:28].max() < -0.1


def plates(opacity: float = 1.0) -> MeshTile:
    """A roof over the middle half of the tile, which rises by 0.1 along x and 0.05 along y, over a floor."""
    x = np.array([0.0, 1.0, 1.0, 0.0, 0.25, 0.75, 0.75, 0.25])
    y = np.array([0.0, 0.0, 1.0, 1.0] * 2)
    z = np.array([-0.2] * 4 + [-0.15, -0.05, 0.0, -0.1])
    quad = np.array([[0, 1, 2], [0, 2, 3]])
    floor = MeshPart("floor", {"base_color": np.array([0.1, 0.2, 0.3]), "roughness": 0.8, "specular": 0.5})
    roof = {"base_color": np.array([0.9, 0.6, 0.3]), "roughness": 0.3, "metallic": 1.0, "opacity": opacity}
    roof |= {"clearcoat": 0.7, "clearcoat_roughness": 0.2}
    return MeshTile(
        1.0,
        np.column_stack([x, y, z]),
        np.concatenate([quad, quad + 4]),
        np.zeros((8, 2)),
        np.array([0, 0, 1, 1]),
        [floor, MeshPart("roof", roof)],
    )


def test_a_mesh_has_the_heights_slopes_and_layers_of_its_highest_part() -> None:
    found = seen_from_above(plates(), FINEST, REFLECTION)
    columns = found.heights.shape[1]
    x = (np.arange(columns) + 0.5) / columns
    over, y = (x > 0.25) & (x < 0.75), 1.0 - x[:, None]
    wanted = np.where(over, 0.2 * (x - 0.25) - 0.15 + 0.05 * y, -0.2)
    wanted = wanted - wanted.max()
    np.testing.assert_allclose(found.heights, wanted, atol=1e-5)
    assert found.opacity is None
    for name, below, above in (
        ("roughness", 0.8, 0.3),
        ("metallic", 0.0, 1.0),
        ("specular", 0.5, 0.0),
        ("base_color", [0.1, 0.2, 0.3], [0.9, 0.6, 0.3]),
        ("clearcoat", 0.0, 0.7),
        ("slopes", [0.0, 0.0], [0.2, 0.05]),
        ("slope_moments", [0.0, 0.0, 0.0], [0.04, 0.01, 0.0025]),
    ):
        image = getattr(found, name)
        np.testing.assert_allclose(image[:, [2, 16]], [[below, above]] * len(image), atol=1e-5, err_msg=name)


def test_rays_pass_holes_of_a_mesh() -> None:
    found = seen_from_above(plates(opacity=0.4), FINEST, REFLECTION)
    np.testing.assert_allclose(found.heights, 0.0, atol=1e-6)
    assert found.metallic is not None
    assert not found.metallic.any()


def test_shadow_rays_pass_holes_of_a_mesh() -> None:
    for opacity, blocked in ((1.0, True), (0.6, True), (0.4, False)):
        tile = plates(opacity=opacity)
        scene = build_scene(tile, tile.surface(REFLECTION))
        # From between the plates.
        ray = mi.Ray3f(mi.Point3f(0.0, 0.0, -0.18 * scene.unit), mi.Vector3f(0.0, 0.0, 1.0))
        holes = {"holes": scene.surface, "rng": _Half()} if opacity < 1.0 else {}
        found, *_ = scene.geometry.occluded(ray, mi.Mask(True), 1, **holes)
        assert bool(found[0]) == blocked


def test_gaps_of_a_mesh_are_deep_and_flat_and_leave_its_layers() -> None:
    whole = plates()
    roof = replace(whole, faces=whole.faces[2:], part=whole.part[2:])
    found = seen_from_above(roof, FINEST, REFLECTION)
    assert found.opacity is not None
    np.testing.assert_allclose(found.opacity.mean(), 0.5, atol=1e-6)
    gap = found.opacity == 0.0
    for image in (found.slopes, found.slope_moments):
        assert not image[gap].any()
    # Nothing is darker, glossier or smoother because it has gaps.
    np.testing.assert_allclose(found.roughness, 0.3, atol=1e-5)
    np.testing.assert_allclose(found.base_color[..., 1], 0.6, atol=1e-5)
    assert found.heights.min() == pytest.approx(-0.15, abs=3e-3)


def test_slopes_of_a_tube_are_bounded_and_lean_to_both_sides() -> None:
    found = seen(wire((1.0, 0.0, 0.0), 0.25, 0.0))
    along = found.slopes[:, 0, 1]
    assert 0.5 < along.max() <= 3.0
    np.testing.assert_allclose(along, -along[::-1], atol=0.05)
    # Row 0 is the side of large y, where the tube falls.
    assert along[:8].min() < -0.5
    assert found.slope_moments[..., 2].max() <= 9.0
