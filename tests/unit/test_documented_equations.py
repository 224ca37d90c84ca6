"""The labels of equations in the documentation stand at the lines that compute them."""

from __future__ import annotations

import re

from support.paths import ROOT

PAGE = ROOT / "docs" / "explanation" / "models.md"


def test_every_equation_is_linked_to_a_file_that_has_its_label() -> None:
    text = PAGE.read_text()
    labels = set(re.findall(r"\\text\{\((\w\d)\)\}", text))
    linked = {
        label: PAGE.parent.joinpath(path).resolve()
        for names, path in re.findall(r"\[((?:\w\d(?:, )?)+)\]\(([^)]+\.py)\)", text)
        for label in names.split(", ")
    }
    assert labels
    assert labels == set(linked)
    assert {label: path.read_text().count(f"({label})") for label, path in linked.items()} == dict.fromkeys(
        labels, 1
    )
