"""The command after a run names what its fits need by the keys of the recipe."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from mbtf_pipeline.cli.run import _next_command

TIME, QUERIES = {"fit.training.time": "2min"}, {"generate.queries.train": "800/texel"}


@pytest.mark.parametrize(
    ("single", "options", "changes", "words"),
    [
        (
            False,
            {},
            TIME | QUERIES,
            "--set fit.relief.training.time=2min --set generate.queries.train=800/texel",
        ),
        (True, {}, TIME, "--set fit.training.time=2min"),
        # A value that was given already is replaced, others stay.
        (
            False,
            {"quality": "draft", "set": ["fit.relief.training.time=1min", "compare.size=64"]},
            TIME,
            "--quality draft --set compare.size=64 --set fit.relief.training.time=2min",
        ),
        (False, {}, {}, None),
    ],
)
def test_the_next_command_sets_keys_of_the_recipe(
    single: bool, options: dict[str, Any], changes: dict[str, str], words: str | None
) -> None:
    given = {"quality": None, "set": None, **options}
    found = _next_command(Path("r.yaml"), single, given, {"relief": changes, "quick": {}})
    assert found == (None if words is None else f"mbtf-pipeline run r.yaml {words}")
