"""What publishers say is checked: licenses, addresses, dates, names."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from mbtf_gen.config.publish import PublishConfig


@pytest.mark.parametrize(
    ("given", "canonical"),
    [
        ("cc-by-4.0", "CC-BY-4.0"),
        ("mit or apache-2.0", "MIT OR Apache-2.0"),
        ("LicenseRef-Ours", "LicenseRef-Ours"),
    ],
)
def test_licenses_get_their_canonical_spelling(given: str, canonical: str) -> None:
    assert PublishConfig(license=given).license == canonical


@pytest.mark.parametrize(
    "said",
    [
        {"license": "Creative Commons"},
        {"license": ""},
        {"url": "ftp://example.org/a"},
        {"url": "example.org/a"},
        {"date": "2026-13-01"},
        {"date": "today"},
        {"name": "two\nlines"},
        {"name": "\x1b[2J"},
        {"author": ["Ada", ""]},
        {"citation": "x\x00"},
        {"citation": "x" * 30_000},
    ],
)
def test_what_cannot_be_published_is_refused(said: dict[str, Any]) -> None:
    with pytest.raises(ValidationError) as fault:
        PublishConfig.model_validate({"license": "MIT", **said})
    assert fault.value.errors()[0]["loc"][0] == next(iter(said))


def test_authors_are_separated_as_in_bibtex() -> None:
    said = PublishConfig.model_validate(
        {"license": "MIT", "author": "Lovelace, Ada and Mary  and  Ferdinand"}
    )
    assert list(said.author) == ["Lovelace, Ada", "Mary", "Ferdinand"]


def test_addresses_cannot_end_a_link() -> None:
    config = PublishConfig.model_validate({"license": "MIT", "url": "https://example.org/a b>`<x"})
    assert config.url == "https://example.org/a%20b%3E%60%3Cx"
