"""The report in a headless browser: slider, selections and error maps."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Callable, Iterator
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
# Size of the images, and of the stage, a multiple of it.
PIXELS, STAGE = 48, 480

# A run with two fits, two widths and both kinds of reference.
OPTIONS = (
    "fit.neumip.training={steps: 60, batch: 2048}",
    "fit.plain={model: neumip-baseline, training: {steps: 20, batch: 2048}}",
    "compare.tiles_across=[2, 4]",
    f"compare.size={PIXELS}",
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

    def until(self, condition: Callable[[], Any], what: str) -> None:
        from selenium.webdriver.support.ui import WebDriverWait

        WebDriverWait(self.driver, TIMEOUT, 0.05).until(lambda _: condition(), what)

    def wait_for(self, scene: int, kind: int, fit: int) -> None:
        """Wait until the stage shows this selection."""
        wanted = f"{scene} {kind} {fit}"
        self.until(lambda: self.js("return document.getElementById('stage').dataset.drawn") == wanted, wanted)

    def image(self, css: str) -> np.ndarray:
        """Pixels (rows, columns, 3) of an image."""
        data = base64.b64decode(self.find(css).get_attribute("src").partition(",")[2])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), np.int64)

    def screen(self) -> np.ndarray:
        """The stage on the screen: colors at the centers of the images' pixels (rows, columns, 3)."""
        png = self.find("#stage").screenshot_as_png
        image = np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), np.int64)
        assert image.shape == (STAGE, STAGE, 3)
        step = STAGE // PIXELS
        return image[step // 2 :: step, step // 2 :: step]

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
        # An integer number of screen pixels per image pixel allows exact comparisons.
        opened.js(
            "const s = document.createElement('style'); document.head.append(s);"
            f"s.textContent = '.stage {{ width: {STAGE}px; border-radius: 0 }}"
            ".stage img { image-rendering: pixelated }"
            ".side, .border { visibility: hidden }"
            "#stage:focus { outline: none }';"
        )
        opened.wait_for(0, 0, 0)
        yield opened


@pytest.fixture
def stage(page: Page) -> Iterator[Any]:
    """The stage in its initial state; afterwards, the logs must contain no error."""
    page.js(
        "for (const name of ['fit', 'kind', 'group'])"
        " document.querySelector(`input[name=${name}][value='0']`).click();"
        "document.querySelector('#tiles-across input').click();"
        "document.querySelector('input[name=map]').click()"
    )
    page.wait_for(0, 0, 0)
    yield page.find("#stage")
    assert [e["message"] for e in page.driver.get_log("browser") if e["level"] == "SEVERE"] == []


def matches(found: np.ndarray, expected: np.ndarray) -> bool:
    """Equal up to the rounding of the browser."""
    return found.shape == expected.shape and int(np.abs(found - expected).max()) <= 1


def test_selections_change_the_images(page: Page, stage: Any) -> None:
    def choose(name: str, value: str) -> None:
        page.js(f"document.querySelector(`input[name={name}][value='{value}']`).click()")

    kinds, fits = ("query", "pixel"), ("neumip", "plain")
    # With the other view, the field of view stays selected.
    for name, selected in (
        ("fit", (0, 0, 1)), ("kind", (0, 1, 1)), ("scene", (1, 1, 1)), ("group", (3, 1, 1)),
    ):  # fmt: skip
        choose(name, "1")
        page.wait_for(*selected)
        scene, kind, fit = selected
        assert matches(page.image("#reference"), page.expected(scene, kinds[kind]))
        assert matches(page.image("#fit"), page.expected(scene, fits[fit]))
    assert "4 tiles across" in page.find("#caption").text


def test_error_maps_match_the_selection(page: Page, stage: Any) -> None:
    def shown() -> list[str]:
        bars = page.driver.find_elements("css selector", "#maps .color-bar")
        return [bar.text for bar in bars if bar.is_displayed()]

    first = page.find("#map-image").get_attribute("src")
    assert first == page.js("return document.getElementById('pictures/v1-l1-s1-fit-neumip-local').src")
    assert [bar.startswith("Local RMS error, % of white") for bar in shown()] == [True]
    page.js("document.querySelector('input[name=map][value=flip]').click()")
    page.until(lambda: page.find("#map-image").get_attribute("src") != first, "the other map")
    assert [bar.startswith("HDR-FLIP") for bar in shown()] == [True]
    page.js("document.querySelector('input[name=map][value=signed]').click()")
    page.until(lambda: "Fit" in page.find("#map-image").get_attribute("alt"), "the difference")
    colors = page.image("#map-image")
    difference = (page.expected(0, "neumip") - page.expected(0, "query")).mean(axis=-1)
    # Blue is too dark, orange too bright.
    assert colors[difference > 40, 0].mean() > colors[difference > 40, 2].mean()
    assert colors[difference < -40, 2].mean() > colors[difference < -40, 0].mean()
