"""The report in a headless browser: slider, selections and error maps."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from support.browser import browser
from support.paths import ROOT

from mbtf_core.app.console import run
from mbtf_core.color import ALBEDO_EXPOSURE, to_display
from mbtf_pipeline.cli.app import app
from mbtf_pipeline.compare.image_files import read_picture

# Seconds to wait for the browser.
TIMEOUT = 120
# A run with two fits, two widths and both kinds of reference.
OPTIONS = (
    "fit.neumip.training={steps: 60, batch: 2048}",
    "fit.plain={model: neumip-baseline, training: {steps: 20, batch: 2048}}",
    "compare.tiles_across=[2, 4]",
    "compare.size=48",
    "compare.spp=16",
)


class Page:
    """The report in a browser."""

    def __init__(self, driver: Any, folder: Path) -> None:
        self.driver = driver
        self.folder = folder
        self.record = json.loads((folder / "compare" / "comparison.json").read_text())
        driver.set_page_load_timeout(TIMEOUT)
        driver.set_script_timeout(TIMEOUT)
        driver.get((folder / "report.html").as_uri())

    def find(self, css: str) -> Any:
        return self.driver.find_element("css selector", css)

    def js(self, code: str, *arguments: Any) -> Any:
        return self.driver.execute_script(code, *arguments)

    def wait_for(self, scene: int, kind: int, fit: int) -> None:
        """Wait until the stage shows this selection."""
        from selenium.webdriver.support.ui import WebDriverWait

        wanted, code = f"{scene} {kind} {fit}", "return document.getElementById('stage').dataset.drawn"
        WebDriverWait(self.driver, TIMEOUT, 0.05).until(lambda _: self.js(code) == wanted, wanted)

    def image(self, css: str) -> np.ndarray:
        """Pixels (rows, columns, 3) of an image."""
        data = base64.b64decode(self.find(css).get_attribute("src").partition(",")[2])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), np.int64)

    def expected(self, scene: int, what: str) -> np.ndarray:
        """Expected display of an image: ``query``, ``pixel``, or the name of a fit."""
        picture = self.record["pictures"][scene]
        file = (picture["references"] if what in ("query", "pixel") else picture["fits"])[what]["file"]
        value = read_picture(self.folder / "compare" / file)
        return to_display(value, ALBEDO_EXPOSURE).astype(np.int64)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    folder = tmp_path_factory.mktemp("report") / "run"
    with browser(tmp_path_factory.mktemp("profile")) as driver:
        options = [word for option in OPTIONS for word in ("--set", option)]
        assert run(app, ["run", str(ROOT / "pipelines" / "ci.yaml"), "-o", str(folder), "-q", *options]) == 0
        opened = Page(driver, folder)
        opened.wait_for(0, 0, 0)
        yield opened


def test_selections_change_the_images(page: Page) -> None:
    """Equal up to the rounding of the browser, whose log has no error."""
    kinds, fits = ("query", "pixel"), ("neumip", "plain")
    # With the other view, the field of view stays selected.
    for name, selected in (
        ("fit", (0, 0, 1)), ("kind", (0, 1, 1)), ("scene", (1, 1, 1)), ("group", (3, 1, 1)),
    ):  # fmt: skip
        page.js(f"document.querySelector(`input[name={name}][value='1']`).click()")
        page.wait_for(*selected)
        scene, kind, fit = selected
        for css, what in (("#reference", kinds[kind]), ("#fit", fits[fit])):
            assert np.abs(page.image(css) - page.expected(scene, what)).max() <= 1
    assert "4 tiles across" in page.find("#caption").text
    assert [e["message"] for e in page.driver.get_log("browser") if e["level"] == "SEVERE"] == []
