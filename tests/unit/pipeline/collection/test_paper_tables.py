"""Tables of paper recipes: measured and published numbers, and marks for insignificant ones."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from support.paths import ROOT

from mbtf_core.stats import Estimate, ratio_of
from mbtf_pipeline.collection.finished_run import FinishedRun, mean_of
from mbtf_pipeline.collection.paper_tables import ablations, methods
from mbtf_pipeline.collection.recipes import PaperRecipe, first_known, load
from mbtf_pipeline.tables import Table

PAPER = load(ROOT / "pipelines" / "paper_methods.yaml")
assert isinstance(PAPER, PaperRecipe)
PUBLISHED = PAPER.published
MSE = {"neumip-baseline": 4e-4, "neumip": 2e-4}


def number(value: float, error: float) -> dict[str, Any]:
    return {"value": value, "error": error, "n": 100}


def errors(mse: float, error: float = 1e-6) -> dict[str, Any]:
    return {"unexplained": number(1e3 * mse, 1e3 * error), "mse": number(mse, error)}


def record(folder: Path) -> dict[str, Any]:
    """A comparison of two fits with one image, including its files."""
    (folder / "compare").mkdir(parents=True, exist_ok=True)
    for name in ("reference", *MSE):
        Image.new("RGB", (4, 4), (90, 80, 70)).save(folder / "compare" / f"{name}.png")
    metrics = {"flip": {"ldr": 0.2, "hdr": 0.3}, "ssim": 0.9, "st_lpips": None}
    relative = {"psnr": number(30, 1), "relative_mse": number(0.1, 0.01)}
    fits = {
        fit: {"file": fit, "errors": {"query": {"mse": number(mse, 1e-6), **relative}}, **metrics}
        for fit, mse in MSE.items()
    }
    noise = {"file": "reference", "flip": {"ldr": 0.1, "hdr": 0.35}, "ssim": 0.95, "st_lpips": None}
    picture = {"levels": [2.0, 2.0], "references": {"query": noise}, "fits": fits, "tiles_across": 1.0}
    sizes = {"texels": 700, "network_weights": 3254}
    test = {
        fit: {
            "splits": {"test": {**errors(mse), "levels": {"0": errors(mse / 4), "1": errors(mse)}}},
            **{"training_seconds": 12.0, "training_steps": 700, "model": fit, **sizes},
        }
        for fit, mse in MSE.items()
    }
    test["neumip"]["mse_minus_first"] = number(-2e-4, 3e-4)
    common = {"fits": list(MSE), "kinds": ["query"], "white": 0.2, "finest": 1, "offsets": []}
    return common | {"pictures": [picture], "test": test}


def make(folder: Path, material: str = "turtle_shell", variant: str = "", **more: Any) -> FinishedRun:
    manifest = {"splits": {"train": {"queries": 1600}}, "levels": {"finest": 1}, "tile": {"aspect": 1.0}}
    return FinishedRun(material, variant, folder, record(folder) | more, manifest)


def rows_of(table: Table) -> list[dict[str, str]]:
    """Rows of the page by column title."""
    shown = table.for_page()
    return [dict(zip(shown["head"], row, strict=True)) for row in shown["rows"]]


def csv_of(table: Table) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(table.csv())))


def test_methods_mark_insignificant_and_missing_numbers(tmp_path: Path) -> None:
    table, ratios = methods([make(tmp_path)], PUBLISHED)
    first, second = rows_of(table)
    assert first["MSE [10⁻³/sr²]"] == "0.4000 ± 0.0010"
    assert second["MSE − MSE of the first method [10⁻³/sr²]"] == "not significant (−0.2 ± 0.3)"
    assert second["HDR-FLIP"] == "0.300, within noise"
    assert second["LDR-FLIP"] == "0.200"
    assert second["ST-LPIPS"] == "–"
    # PSNR of the mean MSE over the images, with white as peak.
    assert float(csv_of(table)[0]["psnr"]) == pytest.approx(10 * math.log10(0.04 / 4e-4), rel=1e-4)
    assert csv_of(table)[1]["mse_minus_first_se"] == "0.0003"
    (measured,) = rows_of(ratios)
    assert measured["MSE ratio, measured here"] == "0.500 ± 0.003"
    assert float(csv_of(ratios)[0]["published"]) == pytest.approx(1.31 / 3.35, rel=1e-4)
    assert measured["source"] == "Kuznetsov et al. 2021"


def test_published_numbers_match_the_papers() -> None:
    def mse_ratio(material: str, method: str, base: str) -> tuple[float | None, str | None]:
        return first_known(PUBLISHED, lambda p: p.mse_ratio(material, method, base))

    found = mse_ratio("insulation_foam", "rainer2020", "neumip")
    assert found == (pytest.approx(21.75 / 3.90), "Kuznetsov et al. 2021")
    assert mse_ratio("insulation_foam", "hierarchical", "neumip") == (None, None)
    decibels, _ = mse_ratio("turtle_shell", "hierarchical", "neumip")
    assert decibels is not None
    assert -10 * math.log10(decibels) == pytest.approx(32.18 - 30.79)


def test_ablations_compare_with_the_first_row(tmp_path: Path) -> None:
    runs = [make(tmp_path, variant="architecture"), make(tmp_path, variant="queries-100")]
    rows = csv_of(ablations(runs, PUBLISHED)[0])
    assert [r["variant"] for r in rows] == ["neumip-baseline", "neumip"] * 2
    assert rows[0]["minus_first"] == ""
    # Paired on the same data, otherwise from two independent errors.
    less = "minus_first"
    assert (rows[1][less], rows[1][f"{less}_se"]) == ("-0.0002", "0.0003")
    assert float(rows[3][less]) == pytest.approx(-2e-4)
    assert float(rows[3][f"{less}_se"]) == pytest.approx(math.hypot(1e-6, 1e-6), rel=1e-3)
    assert rows[0]["queries_per_texel"] == "400"


def test_means_and_ratios_have_error_bars() -> None:
    mean = mean_of([Estimate(1.0, 0.3, 10), Estimate(3.0, 0.4, 10)])
    assert (mean.value, mean.error) == (2.0, pytest.approx(0.25))
    ratio = ratio_of(Estimate(2.0, 0.2, 10), Estimate(4.0, 0.4, 10))
    assert (ratio.value, ratio.error) == (0.5, pytest.approx(0.5 * math.hypot(0.1, 0.1)))
    assert math.isnan(ratio_of(Estimate(2.0, 0.2, 10), Estimate(0.4, 0.4, 10)).value)
