"""``docs/reference/data-format.md`` explains every stored name, and the reader that it shows runs."""

from __future__ import annotations

import re
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.datasets import write_dataset
from support.paths import ROOT

DOCUMENT = (ROOT / "docs/reference/data-format.md").read_text(encoding="utf-8")
QUERIES = {"train": "160", "test": "64"}
SMALL = {"shard_queries": 64}


def section(title: str) -> str:
    """Text of one section of the document."""
    found = re.search(rf"^## {title}\n(.*?)(?=^## |\Z)", DOCUMENT, re.M | re.S)
    assert found is not None, title
    return found[1]


def reader() -> Any:
    """The function of the document's reader."""
    assert "examples/read_data.py" in section("Reader")
    return runpy.run_path(str(ROOT / "examples/read_data.py"))["read_split"]


@pytest.mark.parametrize("layout", ["shuffled", "image"])
def test_the_reader_reads_what_is_written(tmp_path: Path, layout: str) -> None:
    data = write_dataset(tmp_path / "shards", queries={**QUERIES, "layout": layout}, output=SMALL)
    read_split = reader()
    for split in ("train", "test"):
        expected, found = data.load(split), read_split(str(data.folder), split)
        assert set(found) == set(expected)
        assert all(np.array_equal(found[name], expected[name]) for name in expected)


def test_every_key_of_manifest_and_sidecar_is_explained(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "shards", queries=QUERIES, output=SMALL)
    manifest, sidecar = data.manifest, data.shards("train")[0].sidecar
    split = manifest["splits"]["train"]
    in_manifest = [manifest, manifest["tile"], manifest["levels"], manifest["levels"]["mixture"], split]
    in_manifest += [manifest["effects"], manifest["effects"]["effects"][0]]
    in_manifest += [split["shards"][0], next(iter(manifest["arrays"].values())), manifest["geometry"]]
    in_sidecar = [sidecar, sidecar["seed"], sidecar["quarantined"], sidecar["statistics"]]
    counts = set(sidecar["quarantined"])
    for title, objects in (
        ("Manifest", [*in_manifest, set(manifest["summary"]) - counts]),
        ("Sidecar", in_sidecar),
    ):
        missing = [key for found in objects for key in found if f"`{key}`" not in section(title)]
        assert not missing, f"{title} does not explain {missing}"
    for title, top in (("Manifest", manifest), ("Sidecar", sidecar)):
        first_list = next(block for block in section(title).split("\n\n") if "- `" in block[:4])
        keys = "".join(re.findall(r"^- (`[^:]*):", first_list, re.M))
        # Two keys are those of measured data alone.
        measured = {"estimates", "measured"} if title == "Manifest" else set()
        assert set(re.findall(r"`([^`]+)`", keys)) == {*top, "checksum", *measured}
