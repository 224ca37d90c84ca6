"""One browser for all tests of the viewer."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from support.browser import SOFTWARE, browser


@pytest.fixture(scope="session")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with browser(tmp_path_factory.mktemp("profile"), SOFTWARE, "700,500") as started:
        yield started
