"""Makes docs/pictures/viewer.jpg: the viewer's page of the quickstart in a headless Chromium.

From the repository's root, after ``make demo``: ``.venv/bin/python docs/pictures/make_viewer_picture.py``.
Chromium draws by the processor, which takes minutes.
"""

from __future__ import annotations

import io
import json
import shutil
import sys
import time
from pathlib import Path
from urllib.parse import quote

from PIL import Image
from selenium import webdriver
from selenium.webdriver.chrome.service import Service

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
ROOT = Path(__file__).parents[2]
PAGE = ROOT / "out" / "quickstart" / "viewer.html"
SIZE, FRAMES, SECONDS = (1200, 760), 12, 900.0
STATE = {
    "camera": {"elevation": 38, "azimuth": -80, "tiles_across": 3.2, "target": [0.5, 0.4, 0]},
    "lights": [{"direction": [0.62, 0.35, 0.70], "color": [1, 0.95, 0.88], "intensity": 4}],
    "environment": {"name": "sky", "intensity": 0.5, "angle": 40},
    "exposure": 0.6,
}
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)


def main() -> None:
    """Open the page, wait for some frames, ask for the values at a point, and capture."""
    browser = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    driver_path = shutil.which("chromedriver")
    if browser is None or driver_path is None:
        sys.exit("error: needs chromium and chromedriver")
    if not PAGE.is_file():
        sys.exit(f"error: {PAGE} is missing: run make demo")
    options = webdriver.ChromeOptions()
    options.binary_location = browser
    for flag in (*FLAGS, f"--window-size={SIZE[0]},{SIZE[1] + 140}"):
        options.add_argument(flag)
    driver = webdriver.Chrome(options=options, service=Service(executable_path=driver_path))
    try:
        driver.set_script_timeout(SECONDS)
        driver.get(f"{PAGE.as_uri()}#{quote(json.dumps(STATE))}")
        end = time.monotonic() + SECONDS
        while time.monotonic() < end:
            frames = driver.execute_script("return window.mbtf?.viewer.renderer.means.full?.frames ?? 0")
            if frames >= FRAMES:
                break
            time.sleep(0.5)
        driver.execute_script(
            "window.mbtf.viewer.draw = () => false; window.mbtf.showPoint(window.mbtf.viewer, 0.42, 0.55);"
            "document.getElementById('status').textContent = ''"
        )
        picture = Image.open(io.BytesIO(driver.get_screenshot_as_png())).convert("RGB")
        picture.save(ROOT / "docs" / "pictures" / "viewer.jpg", quality=75)
    finally:
        driver.quit()


if __name__ == "__main__":
    main()
