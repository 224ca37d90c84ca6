"""A headless browser that reaches no other machine, and pages of the viewer in it."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-background-networking",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--hide-scrollbars",
    "--force-device-scale-factor=1",
    # No name can be resolved, so no other machine can be reached.
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
)
# Without a graphics card: drawing by the processor.
SOFTWARE = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@contextmanager
def browser(
    profile: Path, flags: Sequence[str] = ("--disable-gpu",), size: str = "1300,1000"
) -> Iterator[Any]:
    """An installed browser with its driver; the test is skipped if there is none or it does not start."""
    selenium = pytest.importorskip(
        "selenium.webdriver", reason="no selenium; to enable: pip install selenium"
    )
    from selenium.common.exceptions import WebDriverException
    from selenium.webdriver.chrome.service import Service
    from urllib3.exceptions import HTTPError

    installed = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    driver = shutil.which("chromedriver")
    if installed is None or driver is None:
        pytest.skip("no browser; to enable on Debian: apt-get install chromium chromium-driver")
    options = selenium.ChromeOptions()
    options.binary_location = installed
    for flag in (*_FLAGS, *flags, f"--window-size={size}", f"--user-data-dir={profile}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    with pytest.MonkeyPatch.context() as patch:
        for name in ("no_proxy", "NO_PROXY"):
            patch.setenv(name, "localhost,127.0.0.1")
        patch.setenv("SE_OFFLINE", "true")
        try:
            started = selenium.Chrome(options=options, service=Service(executable_path=driver))
            started.get("about:blank")
        except (WebDriverException, HTTPError, OSError) as error:
            first = (str(error).strip() or type(error).__name__).splitlines()[0]
            pytest.skip(f"the browser does not start ({first})")
        try:
            yield started
        finally:
            started.quit()


_TIMEOUT = 120
_CHOOSE = """
    const input = document.getElementById(arguments[0]);
    input.value = arguments[1];
    input.dispatchEvent(new Event("input"));
"""


class Page:
    """A page in a browser."""

    def __init__(self, driver: Any, html: str, folder: Path, state: dict[str, Any] | None = None) -> None:
        self.driver = driver
        file = folder / "page.html"
        file.write_text(html)
        driver.set_page_load_timeout(_TIMEOUT)
        driver.set_script_timeout(_TIMEOUT)
        driver.get("about:blank")
        # Messages of the page before are not those of this one.
        for kind in ("browser", "performance"):
            driver.get_log(kind)
        driver.get(file.as_uri() + ("" if state is None else "#" + quote(json.dumps(state))))

    def js(self, code: str, *arguments: Any) -> Any:
        return self.driver.execute_script(code, *arguments)

    def until(self, condition: Callable[[], Any]) -> Any:
        start = time.monotonic()
        while not (found := condition()):
            assert time.monotonic() - start < _TIMEOUT, "the page does not answer"
            time.sleep(0.05)
        return found

    def ready(self) -> Page:
        """Wait for the first picture. Messages of what is under way end in an ellipsis, faults do not."""
        message = "document.getElementById('message').textContent"
        self.until(lambda: self.js(f"return window.mbtf !== undefined || !/…$|^$/.test({message})"))
        assert self.js("return window.mbtf !== undefined"), self.message()
        return self

    def message(self) -> str:
        return str(self.js("return document.getElementById('message').textContent"))

    def picture(self, rows: int, columns: int, side: int = 0) -> np.ndarray:
        """Radiance (rows, columns, 4) of one frame; of a comparison, of one side."""
        code = """
            const { viewer } = window.mbtf, { renderer } = viewer, [rows, columns, side] = arguments;
            viewer.draw = () => false;
            const mean = renderer.mean("test", columns, rows, viewer.shown.length);
            mean.restart();
            renderer.frame(mean, viewer.shown, viewer.scene, rows);
            return [...mean.sides[side][0].read(0, 0, columns, rows)];
        """
        found = np.array(self.js(code, rows, columns, side), np.float64).reshape(rows, columns, 4)
        return found[::-1]

    def set(self, state: dict[str, Any]) -> None:
        """Take over a state, as of a link."""
        self.js("window.mbtf.viewer.restore(arguments[0])", "#" + quote(json.dumps(state)))

    def choose(self, name: str, value: Any) -> None:
        """Change an input of the panel."""
        self.js(_CHOOSE, name, value)

    def screen(self, places: Sequence[tuple[float, float]], frames: int = 1) -> np.ndarray:
        """Colors (n, 3) of the canvas at places from its top left, after some frames."""
        code = """
            const [places, frames] = arguments, { viewer } = window.mbtf, { renderer } = viewer;
            const { gl, canvas } = renderer;
            viewer.draw = () => false;
            const mean = renderer.mean("test", canvas.width, canvas.height, viewer.shown.length);
            mean.restart();
            for (let k = 0; k < frames; k++) renderer.frame(mean, viewer.shown, viewer.scene, canvas.height);
            viewer._show(mean);
            return places.map(([x, y]) => {
                const pixel = new Uint8Array(4);
                const [column, row] = [Math.floor(x * canvas.width), Math.floor((1 - y) * canvas.height)];
                gl.readPixels(column, row, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
                return [...pixel].slice(0, 3);
            });
        """
        return np.array(self.js(code, list(places), frames), np.float64)

    def pick(self, x: float, y: float, side: int = 0) -> dict[str, Any] | None:
        """Position, footprint and view of a material at a place of the canvas."""
        found: dict[str, Any] | None = self.js(
            "const { viewer } = window.mbtf, [x, y, side] = arguments;"
            "return viewer.renderer.pick(viewer.materials[side], viewer.scene, x, y)",
            x,
            y,
            side,
        )
        return found

    def faults(self) -> list[str]:
        """Warnings and errors of the browser, and what was loaded from elsewhere."""
        # Waiting for a pixel stalls the pipeline, of which a browser warns.
        known = ("GPU stall due to ReadPixels", "swiftshader", "GroupMarkerNotSet")
        found = [e["message"] for e in self.driver.get_log("browser")]
        for entry in self.driver.get_log("performance"):
            message = json.loads(entry["message"])["message"]
            if message["method"] == "Network.requestWillBeSent":
                found.append(message["params"]["request"]["url"])
        ours = ("about:", "data:", "blob:", "file:", "chrome:")
        return [f for f in found if not any(k in f for k in known) and not f.startswith(ours)]
