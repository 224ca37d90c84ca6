"""``docs/recipes.md`` names every key of a recipe, and no other."""

from __future__ import annotations

import re
import typing
from collections.abc import Iterator

import pytest
from pydantic import BaseModel
from support.paths import DOCS

from mbtf_fit.config import FitConfig
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_pipeline.paper_tables.recipe import Layer, PaperRecipe, TableName
from mbtf_pipeline.recipe import CompareSection, Recipe, ReportSection

TEXT = (DOCS / "recipes.md").read_text()
PAPER = (DOCS / "paper.md").read_text()


def keys(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    for name, field in model.model_fields.items():
        inner = field.annotation
        section = isinstance(inner, type) and issubclass(inner, BaseModel) and model is not Recipe
        if section:
            assert typing.get_origin(inner) is None
            yield from keys(typing.cast(type[BaseModel], inner), f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}"


def documented(heading: str, text: str = TEXT) -> list[str]:
    """Keys in the first column of the table under a heading."""
    section = text.split(f"\n{heading}\n")[1].split("\n#")[0]
    rows = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    return [key for row in rows for key in re.findall(r"`([^`]+)`", row)]


@pytest.mark.parametrize(
    ("heading", "model"),
    [
        ("## The file", Recipe),
        ("### generate", GeneratorConfig),
        ("### fit", FitConfig),
        ("### compare", CompareSection),
        ("### report", ReportSection),
    ],
)
def test_every_key_is_documented(heading: str, model: type[BaseModel]) -> None:
    assert sorted(documented(heading)) == sorted(keys(model))


@pytest.mark.parametrize(("heading", "model"), [("## The file", PaperRecipe), ("### Layers", Layer)])
def test_every_key_of_a_paper_recipe_is_documented(heading: str, model: type[BaseModel]) -> None:
    assert sorted(documented(heading, PAPER)) == sorted(model.model_fields)


def test_every_table_and_every_paper_recipe_is_documented() -> None:
    for table in typing.get_args(TableName):
        assert f"`{table}`" in PAPER
    for path in (DOCS.parent / "pipelines").glob("paper_*.yaml"):
        assert f"| `pipelines/{path.name}` |" in PAPER
