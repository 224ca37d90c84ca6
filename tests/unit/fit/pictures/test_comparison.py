"""Errors and panels of a constant fit of a rough tile, refusals, resumed pictures; the order of sheets."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import support.scenes  # noqa: F401  # loads Mitsuba
from PIL import Image
from scipy.ndimage import gaussian_filter
from scipy.stats import spearmanr
from support.commands import Done, call, fails
from support.datasets import edit, read_checksummed, write_dataset
from support.plugin_materials import write_material

from mbtf_core.color import to_display
from mbtf_core.directions import from_angles
from mbtf_core.pictures import Camera
from mbtf_fit.backends.mitsuba.evaluator import Evaluator
from mbtf_fit.backends.mitsuba.stored_material import read_material
from mbtf_fit.pictures import grid, sheet
from mbtf_fit.pictures.config import SheetSection
from mbtf_fit.pictures.grid import CAPTION, GAP, MARGIN
from mbtf_gen.config.pictures import Direction
from mbtf_gen.pictures import reference

VALUE = (0.1, 0.12, 0.15)
SIZE, ENLARGED = 128, 3
OPTIONS = ["--view", "50,20", "--light", "60,80", "--spp", "4", "--json"]


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("comparison")
    write_dataset(folder / "shards", queries={"train": "40", "test": "8"})
    inputs = read_checksummed(folder / "shards/manifest.json")["inputs"]
    write_material(folder / "fit", finest=3, aspect=0.5, constant=VALUE, inputs=inputs)
    return folder


def compare(work: Path, *words: str) -> Done:
    paths = [str(work / "fit"), str(work / "shards"), "-o", str(work / "out")]
    return call(["mbtf-fit", "compare", *paths, *OPTIONS, "--size", str(SIZE), *words])


def halves(path: Path) -> list[np.ndarray]:
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    return [np.stack([channels[f"value_{half}.{color}"] for color in "RGB"], -1) for half in "ab"]


def test_errors_and_panels_are_those_of_reference_and_fit(work: Path) -> None:
    done = compare(work)
    report = done.result()
    assert "another material" not in done.err
    exposure = report["exposure"]
    image = np.asarray(Image.open(work / "out/comparison.png")).astype(int)
    # By column and row. A smoothly enlarged picture has its pixels' values at their centers.
    pitch = ENLARGED * SIZE + GAP
    panels = image[MARGIN + CAPTION :, MARGIN:][: 3 * pitch, : 3 * pitch].reshape(3, pitch, 3, pitch, 3)
    panels = panels[:, ENLARGED // 2 : -GAP : ENLARGED, :, ENLARGED // 2 : -GAP : ENLARGED]
    # The finest level has 8 texels: a pixel covers 1, 2, and 4 of them.
    for row, (across, found) in enumerate(zip(("16", "32", "64"), report["pictures"], strict=True)):
        a, b = halves(work / f"out/query-tiles{across}.exr")
        mse = np.mean((VALUE - a.astype(np.float64)) * (VALUE - b))
        assert found["mse"]["value"] == pytest.approx(mse, rel=1e-4)
        spread = ((VALUE - a.astype(np.float64)) * (VALUE - b)).mean(-1)
        assert found["mse"]["error"] == pytest.approx(spread.std(ddof=1) / SIZE, rel=1e-4)
        # Both relative to the mean value, their squared ratio is the unexplained variance.
        covariance = np.mean([np.cov(a[..., c].ravel(), b[..., c].ravel())[0, 1] for c in range(3)])
        assert found["contrast"] == pytest.approx(np.sqrt(covariance) / np.mean(0.5 * (a + b)), rel=1e-3)
        ratio = found["mse"]["value"] / (found["mean"] * found["contrast"]) ** 2
        # In the distance, the noise exceeds the contrast.
        assert row == 2 or found["unexplained"]["value"] == pytest.approx(ratio, rel=1e-3)
        shown, fit, local = (panels[row, :, column] for column in range(3))
        # Labels cover the lower part of the first column.
        assert np.abs(shown - to_display(0.5 * (a + b), exposure))[: SIZE // 2].max() <= 1
        assert np.abs(fit - to_display(VALUE, exposure)).max() <= 1
        # Lightness grows with the local error up to the end of the scale, which is common to all rows.
        smooth = np.sqrt(np.maximum(gaussian_filter(spread, 2.0, mode="nearest"), 0.0))
        lightness = local @ [0.2126, 0.7152, 0.0722]
        inside = lightness < 200
        assert inside.mean() > 0.5
        assert spearmanr(lightness[inside], smooth[inside]).statistic > 0.98


def test_finished_references_are_kept(work: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compare(work)
    before = {path.name: path.read_bytes() for path in (work / "out").glob("*.exr")}
    assert len(before) == 3
    monkeypatch.setattr(reference, "render_reference", None)
    assert compare(work, "--exposure", "1").result()["exposure"] == 1
    assert {path.name: path.read_bytes() for path in (work / "out").glob("*.exr")} == before


def test_what_cannot_be_path_traced_is_one_line(work: Path, tmp_path: Path) -> None:
    for name in ("fit", "shards"):
        shutil.copytree(work / name, tmp_path / name)
    line = ["compare", str(tmp_path / "fit"), str(tmp_path / "shards"), "-o", str(tmp_path / "out")]
    assert "name a material and its data set" in fails(2, "compare", str(tmp_path / "fit"))
    heights, manifest = tmp_path / "moved.npy", tmp_path / "shards/manifest.json"
    edit(manifest, lambda document: document["config"].update(material=str(heights)))
    assert "run this where mbtf-gen ran" in fails(3, *line)
    np.save(heights, np.random.default_rng(1).random((4, 8)))
    assert "moved.npy: has changed since the data set was made" in fails(3, *line)
    edit(manifest, lambda document: document.update(estimates=1))
    assert "holds measured data, whose surface is unknown" in fails(3, *line)
    assert not (tmp_path / "out").exists()


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
