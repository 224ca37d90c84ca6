"""``mbtf-fit preview``: order of the pictures, turntable, and scene."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.plugin_materials import write_material
from support.scenes import mi

import mbtf_fit.backends.mitsuba
from mbtf_core.color import to_display
from mbtf_core.directions import from_angles
from mbtf_core.pictures import Camera
from mbtf_fit.preview.config import SheetSection, TurntableSection
from mbtf_gen.config.pictures import Direction

mbtf_fit.backends.mitsuba.register()

from mbtf_fit.backends.mitsuba.bsdf import Frame  # noqa: E402
from mbtf_fit.backends.mitsuba.evaluator import Evaluator  # noqa: E402
from mbtf_fit.backends.mitsuba.stored_material import read_material  # noqa: E402
from mbtf_fit.preview import grid, sheet, turntable  # noqa: E402

SECTION = SheetSection(
    view=[Direction(elevation=70, azimuth=-90), Direction(elevation=35, azimuth=20)],
    light=[Direction(elevation=60, azimuth=0), Direction(elevation=30, azimuth=120)],
    tiles_across=[0.5, 2.0, 9.0],
    size=64,
)


@pytest.mark.parametrize("model", ["neumip", "relief"])
def test_pictures_are_ordered_by_view_light_and_width(model: str, tmp_path: Path) -> None:
    """Against PyTorch at the same pixels."""
    material = write_material(tmp_path, model=model, aspect=2.0, contrast=1.0)
    values = sheet.panels(Evaluator(read_material(tmp_path), "cooperative"), SECTION)
    assert values.shape == (2, 2, 3, 64, 64, 3)
    pixels = sheet.contact_sheet(values, SECTION, exposure := 2.0)
    pitch = 64 + grid.GAP
    for view, light, row in np.ndindex(2, 2, 3):
        v, i = SECTION.view[view], SECTION.light[light]
        camera = Camera(v.elevation, v.azimuth, SECTION.tiles_across[row], (0.5, 1.0), 64, 64)
        queries = camera.queries(from_angles(i.elevation, i.azimuth), 2.0).flat()
        wanted = material.predict(queries).reshape(64, 64, 3)  # type: ignore[arg-type]
        np.testing.assert_allclose(values[view, light, row], wanted, rtol=1e-3, atol=1e-4)
        left = grid.MARGIN + (2 * view + light) * pitch + view * grid.GAP
        top = grid.MARGIN + grid.CAPTION + row * pitch
        shown = pixels[top : top + 64, left : left + 64].astype(int)
        difference = np.abs(shown - to_display(wanted, exposure))
        # The first column carries labels below.
        assert difference[: 32 if (view, light) == (0, 0) else 64].max() <= 1
    flat = values.reshape(12, -1)
    assert min(np.abs(a - b).max() for k, a in enumerate(flat) for b in flat[:k]) > 1e-3


def white(tmp_path: Path) -> Any:
    write_material(tmp_path, constant=(0.25, 0.25, 0.25))
    return mi.load_dict(
        {"type": "mbtf", "material": str(tmp_path), "networks": "cooperative", "sampling": "cosine"}
    )


def test_tiles_on_the_ball_are_square_and_upright(tmp_path: Path) -> None:
    """Eight around the equator; x to the east and y to the north, at every latitude."""
    scene = mi.load_dict({"type": "scene", "ball": turntable.ball(white(tmp_path), 8)})
    latitude = np.radians([-75.0, -40.0, 1.0, 31.0, 61.0, 70.0])
    azimuth = np.radians([5.0, 100.0, 200.0, 302.0, 355.0, 61.0])
    out = np.stack([np.cos(latitude) * np.cos(azimuth), np.cos(latitude) * np.sin(azimuth), np.sin(latitude)])
    ray = mi.Ray3f(mi.Point3f(3.0 * out), mi.Vector3f(-out))
    si = scene.ray_intersect(ray, mi.RayFlags.All, True)
    du, dv = np.array(si.dp_du), np.array(si.dp_dv)
    lengths = np.linalg.norm(du, axis=0), np.linalg.norm(dv, axis=0)
    np.testing.assert_allclose(lengths[0], 2 * np.pi / 8 * np.cos(latitude), rtol=0.07)
    np.testing.assert_allclose(lengths[1], lengths[0], rtol=0.07)
    assert np.abs((du * dv).sum(0) / lengths[0] / lengths[1]).max() < 0.07
    frame = Frame.at(si)
    east = si.to_world(frame.to_local(mi.Vector3f(1, 0, 0)))
    north = si.to_world(frame.to_local(mi.Vector3f(0, 1, 0)))
    to_east = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(6)])
    assert (np.array(east) * to_east).sum(0).min() > 0.99
    to_north = np.cross(out, to_east, axis=0)
    assert (np.array(north) * to_north).sum(0).min() > 0.99


def test_rotation_changes_patterned_materials_only(tmp_path: Path) -> None:
    """Camera and lights go round together; the material stays."""
    section = TurntableSection(size=24, frames=3, spp=64)
    same = list(turntable.frames(white(tmp_path / "white"), section))
    assert len(same) == 3
    for picture in same[1:]:
        assert np.abs(picture - same[0]).mean() < 0.08 * same[0].mean()
    lit = same[0].mean(-1)
    # The key light comes from the left, so the ball's shadow falls to the right.
    assert lit[15, 4:7].mean() > 1.3 * lit[15, 17:20].mean(), lit[15]
    write_material(tmp_path / "patterned", model="neumip-baseline", contrast=1.5)
    patterned = mi.load_dict(
        {"type": "mbtf", "material": str(tmp_path / "patterned"), "networks": "cooperative"}
    )
    turned = list(turntable.frames(patterned, section.model_copy(update={"tiles": 2})))
    assert np.abs(turned[1] - turned[0]).mean() > 0.12 * turned[0].mean()


def test_a_signal_after_a_frame_interrupts(tmp_path: Path) -> None:
    """Mitsuba's own handler, which ignores the signal, may stay behind after an integrator in Python."""
    section = TurntableSection(frames=3, size=16, spp=1, tiles=1)
    pictures = turntable.frames(white(tmp_path), section)
    next(pictures)
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_a_white_plate_and_a_white_sheet_have_one_exposure(tmp_path: Path) -> None:
    """Constant value 1/4 under unit irradiance: the turntable's plate shows what the sheet shows."""
    section = TurntableSection(size=24, frames=1, spp=256)
    (picture,) = turntable.frames(white(tmp_path), section)
    # The plate in front of the ball, which shadows none of the lights there and hides some of the sky.
    assert picture[19:21, 8:11].mean() == pytest.approx(0.25, rel=0.12)
