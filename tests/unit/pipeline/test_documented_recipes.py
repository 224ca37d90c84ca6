"""The recipes that the documentation shows are valid."""

from __future__ import annotations

import re
from pathlib import Path

from support.paths import ROOT

from mbtf_pipeline.library.entries import is_library_recipe, load_library_recipe
from mbtf_pipeline.papers.plan import is_paper_recipe, load_paper_recipe
from mbtf_pipeline.recipe import load_recipe


def test_the_recipes_of_the_page_are_valid(tmp_path: Path) -> None:
    text = (ROOT / "docs/how-to/run-recipes.md").read_text(encoding="utf-8")
    (tmp_path / "assets").symlink_to(ROOT / "assets")
    (tmp_path / "pipelines").mkdir()
    kinds = set()
    for number, shown in enumerate(re.findall(r"^```yaml\n(.*?)^```", text, re.DOTALL | re.MULTILINE)):
        path = tmp_path / "pipelines" / f"shown_{number}.yaml"
        path.write_text(shown, encoding="utf-8")
        if is_paper_recipe(path):
            kinds.add("paper")
            assert load_paper_recipe(path, []).materials
        elif is_library_recipe(path):
            kinds.add("library")
            load_library_recipe(path, [])
        else:
            kinds.add("recipe")
            assert load_recipe(path).fit
    assert kinds == {"recipe", "library", "paper"}
