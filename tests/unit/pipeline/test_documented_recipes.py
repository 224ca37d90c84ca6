"""The recipe that the documentation shows is valid."""

from __future__ import annotations

import re
from pathlib import Path

from support.paths import ROOT

from mbtf_pipeline.collection.recipes import load
from mbtf_pipeline.recipe import Recipe


def test_the_recipe_of_the_page_is_valid(tmp_path: Path) -> None:
    text = (ROOT / "docs/how-to/run-recipes.md").read_text(encoding="utf-8")
    (shown,) = re.findall(r"^```yaml\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    (tmp_path / "assets").symlink_to(ROOT / "assets")
    (tmp_path / "pipelines").mkdir()
    path = tmp_path / "pipelines" / "shown.yaml"
    path.write_text(shown, encoding="utf-8")
    assert isinstance(load(path), Recipe)
