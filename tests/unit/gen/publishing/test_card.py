"""The data card: what it says is true, its code runs, names of others are harmless, nothing is loaded."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from markdown_it import MarkdownIt
from support.datasets import edit
from support.measured_files import btf
from support.published import LAYOUTS, publish, python_blocks, small, stored

from mbtf_core.data.dataset import Dataset
from mbtf_gen.config.measured import ImportConfig
from mbtf_gen.config.publish import PublishConfig
from mbtf_gen.generation.imported import Import, import_measured
from mbtf_gen.publishing.card import card_text
from mbtf_gen.publishing.facts import Facts

HOSTILE = '<script>alert("1")</script> ![x](https://example.org/p.png) | `*_'


def front_matter(card: Path) -> dict[str, Any]:
    text = (card / "README.md").read_text()
    return dict(yaml.safe_load(text.split("---\n")[1]))


def page(card: Path) -> str:
    text = (card / "README.md").read_text().split("---\n", 2)[2]
    return MarkdownIt("commonmark", {"html": True}).enable("table").render(text)


def run_block(block: str, card: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.chdir(card)
    names: dict[str, Any] = {}
    exec(compile(block, "README.md", "exec"), names)
    return names["value_a"]


@pytest.mark.parametrize("form", ["parquet", "webdataset", "npz"])
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


@pytest.mark.parametrize("form", ["parquet", "webdataset"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_datasets_of_hugging_face_loads_the_folder(layout: str, form: str, tmp_path: Path) -> None:
    pytest.importorskip("datasets")
    small(tmp_path / "data", layout)
    card = publish(tmp_path / "data", tmp_path / "card", form=form)
    block = python_blocks((card / "README.md").read_text())[-1]
    if form == "webdataset":
        name = '"test", ' if layout == "slices" else ""
        block = (
            "import os\nfrom datasets import load_dataset\n"
            f'data = load_dataset(os.getcwd(), {name}split="test").with_format("numpy")\n'
            'value_a = data[:1]["value_a.npy"][0]'
        )
    code = f"{block}\nimport numpy\nnumpy.save({str(tmp_path / 'found.npy')!r}, value_a)"
    homes = {"HF_HOME": str(tmp_path / "home"), "HF_HUB_OFFLINE": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=card, env=os.environ | homes, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    found, expected = np.load(tmp_path / "found.npy"), stored(tmp_path / "data", "test")["value_a"]
    count = min(len(found), len(expected))
    np.testing.assert_array_equal(np.asarray(found, np.float32)[:count], expected[:count])
    assert count >= 4


def test_front_matter_is_that_of_data_hubs(tmp_path: Path) -> None:
    small(tmp_path / "data")
    card = publish(tmp_path / "data", tmp_path / "card", form="webdataset", license="cc-by-4.0", name=HOSTILE)
    found = front_matter(card)
    assert found["license"] == "cc-by-4.0"
    assert found["pretty_name"] == HOSTILE
    assert found["size_categories"] == ["n<1K"]
    assert found["configs"] == [
        {
            "config_name": "default",
            "data_files": [{"split": s, "path": f"data/{s}-*.tar"} for s in ("train", "test")],
        }
    ]
    for files in found["configs"][0]["data_files"]:
        assert list(card.glob(files["path"]))
    other = publish(tmp_path / "data", tmp_path / "other", form="npz", license="LicenseRef-Mine")
    found = front_matter(other)
    assert (found["license"], found["license_name"]) == ("other", "LicenseRef-Mine")


def test_statistics_are_those_of_the_data(tmp_path: Path) -> None:
    small(tmp_path / "data")
    text = (publish(tmp_path / "data", tmp_path / "card", form="npz") / "README.md").read_text()
    row = next(line for line in text.splitlines() if line.startswith("| train |")).split(" | ")
    arrays = stored(tmp_path / "data", "train")
    value = 0.5 * (arrays["value_a"].astype(np.float64) + arrays["value_b"])
    for said, channel in zip(row[2].split(", "), value.T, strict=True):
        mean, error = map(float, said.split(" ± "))
        assert mean == pytest.approx(channel.mean(), abs=error)
        assert error == pytest.approx(channel.std() / np.sqrt(len(channel)), rel=0.25)
    noise, error = map(float, row[3].removesuffix(" % |").split(" ± "))
    variance = (arrays["value_a"].astype(np.float64) - arrays["value_b"]) ** 2 / 4
    power = arrays["value_a"].astype(np.float64) * arrays["value_b"]
    assert noise == pytest.approx(100 * np.sqrt(variance.mean() / power.mean()), abs=error)
    assert int(row[1]) == len(value)


def test_names_are_shown_and_nothing_is_loaded_from_elsewhere(tmp_path: Path) -> None:
    small(tmp_path / "data")
    says = {
        "name": HOSTILE,
        "author": [HOSTILE],
        "citation": "```\n<script>\n```",
        "url": "https://example.org/a",
    }
    card = publish(tmp_path / "data", tmp_path / "card", form="npz", **says)
    html = page(card)
    assert "<script" not in html
    assert html.count("&lt;script&gt;") == 3
    sources = re.findall(r'src="([^"]*)"', html)
    assert sources
    for source in sources:
        assert (card / source).is_file()
    assert set(re.findall(r'href="([^"]*)"', html)) == {"https://example.org/a"}
    for file in card.rglob("*"):
        if file.suffix in (".md", ".json", ".yaml", ".sh"):
            assert str(tmp_path) not in file.read_text(), file


def test_measured_data_say_what_they_lack(tmp_path: Path) -> None:
    (tmp_path / "felt.btf").write_bytes(btf())
    config = ImportConfig.model_validate({"queries": {"train": "300", "test": "20", "min_cos": 0.2}})
    import_measured(Import.prepare(tmp_path / "felt.btf", config), tmp_path / "data")
    card = publish(tmp_path / "data", tmp_path / "card", form="webdataset")
    text = (card / "README.md").read_text()
    assert "# felt\n" in text
    assert "There is no recipe" in text
    assert "is the only value of a query" in text
    assert "value_b" not in text
    assert not (card / "recipe").exists()
    assert "| train | 160 |" in text
    assert " | unknown |" in text


def test_what_is_left_out_has_its_bound(tmp_path: Path) -> None:
    small(tmp_path / "data")
    path = tmp_path / "data/manifest.json"
    effects = json.loads(path.read_text())["effects"]
    shadowing = next(e for e in effects["effects"] if e["name"] == "shadowing")
    shadowing.update(on=False, present=True, bias_bound=0.0041, error=0.0004, explanation="few | <slopes>")
    edit(path, lambda manifest: manifest.update(effects=effects))
    facts = Facts(Dataset.open(tmp_path / "data"), PublishConfig(license="MIT"))
    text = card_text(facts, {}, maps=False)
    assert "| shadowing | left out | 0.41 ± 0.04 % | few \\| &lt;slopes&gt; |" in text
    assert "| parallax and masking | simulated |" in text
