"""The data card: what it says is true, its code runs, names of others are harmless, nothing is loaded."""

from __future__ import annotations

import html
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from markdown_it import MarkdownIt
from support.published import LAYOUTS, publish, python_blocks, small, stored

from mbtf_gen.config.exchange import PublishConfig
from mbtf_gen.publishing.facts import Facts

HOSTILE = '<script>alert("1")</script> ![x](https://example.org/p.png) | `*_'


def run_block(block: str, card: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.chdir(card)
    names: dict[str, Any] = {}
    exec(compile(block, "README.md", "exec"), names)
    return names["value_a"]


@pytest.mark.parametrize("form", ["parquet", "npz"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_its_code_loads_the_data(
    layout: str, form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if form == "parquet":
        pytest.importorskip("pyarrow")
    small(tmp_path / "data", layout)
    card = publish(tmp_path / "data", tmp_path / "card", form=form)
    first = python_blocks((card / "README.md").read_text())[0]
    expected = np.load(tmp_path / "data/test-00000.npz")["value_a"]
    found = run_block(first, card, monkeypatch)
    assert found.dtype == np.float32
    assert found.shape == expected.shape
    assert found.tobytes() == expected.tobytes()


@pytest.mark.parametrize("layout", LAYOUTS)
def test_statistics_are_those_of_the_data(layout: str, tmp_path: Path) -> None:
    data = small(tmp_path / "data", layout)
    config = PublishConfig(license="MIT", form="npz")
    facts = Facts(data, config, "a", {split: data.load(split) for split in data.splits}, {})
    for split in data.splits:
        arrays = stored(tmp_path / "data", split)
        a, b = (arrays[name].astype(np.float64) for name in ("value_a", "value_b"))
        assert facts.queries(split) == a[..., 0].size
        # Queries of one row depend on each other: the error is that of the means of rows.
        rows = (a + b).reshape(len(a), -1, 3).mean(axis=1) / 2
        for found, channel in zip(facts.mean(split), rows.T, strict=True):
            assert found.value == pytest.approx(channel.mean(), rel=1e-5)
            assert found.error == pytest.approx(channel.std(ddof=1) / np.sqrt(len(channel)), rel=1e-4)
        noise = facts.noise(split)
        assert noise.value == pytest.approx(np.sqrt(((a - b) ** 2 / 4).mean()) / (a + b).mean() * 2, rel=1e-5)
    # The run has printed the same.
    printed = data.manifest["summary"]["relative_error"]
    assert facts.noise("train").value == pytest.approx(printed, rel=1e-5)


def test_names_are_shown_and_nothing_is_loaded_from_elsewhere(tmp_path: Path) -> None:
    small(tmp_path / "data")
    says = {"name": HOSTILE, "author": [HOSTILE], "citation": "```\n<script>\n```"}
    card = publish(tmp_path / "data", tmp_path / "card", form="npz", url="https://example.org/a", **says)
    text = (card / "README.md").read_text().split("---\n", 2)[2]
    shown = MarkdownIt("commonmark", {"html": True}).enable("table").render(text)
    assert "<script" not in shown
    assert shown.count("&lt;script&gt;") == 3
    # The names, whole, and the citation between its fences.
    assert html.unescape(re.sub(r"<[^>]*>", "", shown)).count(HOSTILE) == 2
    assert "```\n&lt;script&gt;\n```" in shown
    sources = re.findall(r'src="([^"]*)"', shown)
    assert sources
    for source in sources:
        assert (card / source).is_file()
    assert set(re.findall(r'href="([^"]*)"', shown)) == {"https://example.org/a"}
    for file in card.rglob("*"):
        if file.suffix in (".md", ".json", ".yaml", ".sh"):
            assert str(tmp_path) not in file.read_text(), file
