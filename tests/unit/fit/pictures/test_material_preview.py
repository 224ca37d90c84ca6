"""``mbtf-fit preview``: order of the pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import support.scenes  # noqa: F401  # loads Mitsuba
from support.plugin_materials import write_material

from mbtf_core.color import to_display
from mbtf_core.directions import from_angles
from mbtf_core.pictures import Camera
from mbtf_fit.backends.mitsuba.evaluator import Evaluator
from mbtf_fit.backends.mitsuba.stored_material import read_material
from mbtf_fit.pictures import grid, sheet
from mbtf_fit.pictures.config import SheetSection
from mbtf_gen.config.pictures import Direction

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
