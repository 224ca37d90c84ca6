"""Pictures take seconds: only their own tests draw them."""

from __future__ import annotations

import pytest

from mbtf_core.files.atomic import write_chunks
from mbtf_gen.publishing import publication


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    if "draws" not in request.fixturenames:
        monkeypatch.setattr(
            publication, "write_picture", lambda *arguments: write_chunks(arguments[-1], [b"a picture"])
        )


@pytest.fixture
def draws() -> None:
    """Requested by tests of the pictures themselves."""
