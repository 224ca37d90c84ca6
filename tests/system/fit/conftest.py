"""A browser for the tests of the viewer. It ends with a module: a page that is left open draws on."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from support.browser import SOFTWARE, browser


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with browser(tmp_path_factory.mktemp("profile"), SOFTWARE, "700,500") as started:
        yield started
