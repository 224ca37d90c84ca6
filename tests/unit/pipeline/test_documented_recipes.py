"""The recipes that the documentation shows are valid."""

from __future__ import annotations

import re
from pathlib import Path

from support.paths import ROOT

from mbtf_pipeline.collection.recipes import load


def test_the_recipes_of_the_page_are_valid(tmp_path: Path) -> None:
    text = (ROOT / "docs/how-to/run-recipes.md").read_text(encoding="utf-8")
    (tmp_path / "assets").symlink_to(ROOT / "assets")
    (tmp_path / "pipelines").mkdir()
    kinds = set()
    for number, shown in enumerate(re.findall(r"^```yaml\n(.*?)^```", text, re.DOTALL | re.MULTILINE)):
        path = tmp_path / "pipelines" / f"shown_{number}.yaml"
        path.write_text(shown, encoding="utf-8")
        kinds.add(type(load(path)).__name__)
    assert kinds == {"Recipe", "LibraryRecipe", "PaperRecipe"}
