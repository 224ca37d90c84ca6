"""The data card and its picture: what they say and show is true, names of others are harmless."""

from __future__ import annotations

import html
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from markdown_it import MarkdownIt
from PIL import Image
from support.fit_data import constant, write_data
from support.published import LAYOUTS, publish, python_blocks, small, stored

from mbtf_core.data.dataset import Dataset
from mbtf_gen.config.exchange import PublishConfig
from mbtf_gen.publishing.facts import Facts
from mbtf_gen.publishing.picture import tile_image, write_picture

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


def test_the_tile_has_u_and_v_where_they_belong(tmp_path: Path) -> None:
    """Red is a sine of u, green one of v."""

    def value(u, sigma, omega_i, omega_o):  # type: ignore[no-untyped-def]
        red, green = 1.0 + 0.5 * np.sin(2 * np.pi * u.T)
        return np.stack([red, green, np.ones_like(red)], axis=-1)

    write_data(tmp_path / "data", value, train=60_000, test=10, finest=4)
    arrays = Dataset.open(tmp_path / "data").load("train")
    tile = tile_image(arrays, 1.0)
    at = (np.arange(len(tile)) + 0.5) / len(tile)
    wave = np.broadcast_to(1.0 + 0.5 * np.sin(2 * np.pi * at), tile.shape[:2])
    np.testing.assert_allclose(tile[..., 0], wave, atol=0.1)
    np.testing.assert_allclose(tile[..., 1], wave[:, ::-1].T, atol=0.1)


def test_highlights_that_few_queries_see_are_no_specks(tmp_path: Path) -> None:
    """A query in 500 is a thousand times as bright: a mean of 32 queries would exceed white by far."""
    write_data(tmp_path / "data", constant(0.1), train=20_000, test=10, finest=4)
    arrays = Dataset.open(tmp_path / "data").load("train")
    for key in ("value_a", "value_b"):
        arrays[key] = np.where(np.arange(20_000)[:, None] % 500 == 0, 100.0, arrays[key])
    assert np.nanmax(tile_image(arrays, 1.0)) < 0.16


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_has_its_picture(layout: str, tmp_path: Path, draws: None) -> None:
    data = small(tmp_path / "data", layout)
    shown = data.load("train"), data.lattice.aspect, data.geometry()
    first = write_picture(*shown, tmp_path / "a.png")
    assert write_picture(*shown, tmp_path / "b.png").sha256 == first.sha256
    assert np.asarray(Image.open(tmp_path / "a.png").convert("L"), np.float64).std() > 5
