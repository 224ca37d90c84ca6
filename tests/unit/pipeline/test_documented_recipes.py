"""The recipes that how-to pages show are valid."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from support.paths import ROOT

from mbtf_pipeline.papers.plan import is_paper_recipe, load_paper_recipe
from mbtf_pipeline.recipe import load_recipe


@pytest.mark.parametrize("page", ["run-recipes", "reproduce-the-papers"])
def test_the_recipe_of_a_page_is_valid(page: str, tmp_path: Path) -> None:
    text = (ROOT / f"docs/how-to/{page}.md").read_text(encoding="utf-8")
    [shown] = re.findall(r"^```yaml\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    (tmp_path / "assets").symlink_to(ROOT / "assets")
    path = tmp_path / "pipelines" / "shown.yaml"
    path.parent.mkdir()
    path.write_text(shown, encoding="utf-8")
    if is_paper_recipe(path):
        assert list(load_paper_recipe(path, []).materials) == ["turtle_shell", "steep"]
    else:
        assert list(load_recipe(path).fit) == ["relief", "neumip", "wide"]
