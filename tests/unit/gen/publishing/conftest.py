"""Pictures take seconds: only their own tests draw them."""

from __future__ import annotations

import pytest

from mbtf_core.files.atomic import write_chunks
from mbtf_gen.publishing import publish


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    if "draws" not in request.fixturenames:
        makers = {"tile.png": lambda path: write_chunks(path, [b"a picture"])}
        monkeypatch.setattr(publish, "picture_makers", lambda *_: makers)


@pytest.fixture
def draws() -> None:
    """Requested by tests of the pictures themselves."""
