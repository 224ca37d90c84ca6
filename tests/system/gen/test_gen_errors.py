"""What a user can get wrong: one or two lines that say what, where and what to do; the right exit code; no
traceback; nothing written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support.commands import Done, finished, run_all, start
from support.datasets import write_dataset

INPUT, USAGE = 3, 2

# Command line → texts that the message must contain. Files that readers refuse are those of the unit tests.
INPUT_CASES = {
    "nowhere.exr": ["nowhere.exr", "no such file"],
    "notes.doc": ["'.doc'", ".exr"],
    "empty": ["empty", "no image"],
    "heights.npy --config config.yaml --seed 1": ["config.yaml:3", "'queries.mincos'", "'min_cos'"],
    "merge empty": ["empty", "manifest.json"],
    "reference heights.npy -o maps": ["maps", "no pictures"],
    "heights.npy -o maps": ["maps", "holds no data set"],
    "heights.npy -o notes.txt/below": ["notes.txt"],
}
# Options and keys that the schemas refuse are tested by tests/unit/test_refusals.py.
USAGE_CASES = {
    "heights.npy --effects +gloss": ["--effects", "'+gloss' is not an effect", "clearcoat"],
    "heights.npy --queries 1e12/texel": ["shards", "output.shard_queries"],
    "heights.npy --slice 4/3": ["--slice", "4/3"],
    "--queries 5": ["no material"],
    "reference heights.npy --view 5,0": ["horizon", "elevation"],
}
CASES = INPUT_CASES | USAGE_CASES


def write_inputs(folder: Path) -> None:
    """What the cases name; `heights.npy` is good."""
    np.save(folder / "heights.npy", np.random.default_rng(0).random((4, 8)))
    (folder / "notes.txt").write_text("no image")
    (folder / "notes.doc").write_text("no image")
    for name in ("maps", "empty"):
        (folder / name).mkdir()
    np.save(folder / "maps/height.npy", np.zeros((8, 8)))
    (folder / "config.yaml").write_text("queries:\n  spp: 4\n  mincos: 0.2\n")


def listing(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Done]:
    folder = tmp_path_factory.mktemp("errors")
    write_inputs(folder)
    before = listing(folder)
    done = run_all([line.split() for line in CASES], folder)
    # Neither a data set nor pictures, nor anything else.
    assert listing(folder) == before
    return dict(zip(CASES, done, strict=True))


@pytest.mark.parametrize("line", CASES)
def test_invalid_input_is_explained_in_two_lines(line: str, answers: dict[str, Done]) -> None:
    done = answers[line]
    assert done.code == (INPUT if line in INPUT_CASES else USAGE), done
    assert done.out == ""
    assert "Traceback" not in done.err
    lines = done.err.splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("error: "))
    assert len(lines) - first <= 2, done.err
    message = "\n".join(lines[first:])
    for text in CASES[line]:
        assert text in message, message


def test_the_program_itself_ends_with_the_code(tmp_path: Path) -> None:
    done = finished(start(["nowhere.exr", "--queries", "5"], tmp_path))
    assert done == Done(INPUT, "", "error: nowhere.exr: no such file or folder\n")
    assert list(tmp_path.iterdir()) == []


def test_verify_counts_what_an_interrupted_run_has_not_made(tmp_path: Path) -> None:
    write_dataset(tmp_path / "set", queries={"train": "400", "test": "20"}, output={"shard_queries": 40})
    for name in ("train-00003.npz", "train-00004.npz", "train-00007.npz", "train-00008.json"):
        (tmp_path / "set" / name).unlink()
    text, data = run_all([["verify", "set"], ["verify", "set", "--json"]], tmp_path)
    assert (text.code, data.code) == (INPUT, INPUT)
    (line,) = text.out.splitlines()
    assert line.startswith("set: 4 of 11 shards missing, first train-00003.npz")
    assert [f["file"][6:11] for f in json.loads(data.out)["faults"]] == ["00003", "00004", "00007", "00008"]
