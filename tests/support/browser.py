"""A headless browser that reaches no other machine."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

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
