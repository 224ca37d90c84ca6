"""Pipes, devices, links without an end and control characters are refused in one or two printable lines."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from support.commands import call
from support.fit_data import constant, write_data


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("special")
    np.save(made / "heights.npy", np.random.default_rng(0).random((4, 8)))
    (made / "good").mkdir()
    np.save(made / "good/heights.npy", np.random.default_rng(0).random((4, 8)))
    for suffix in ("npy", "exr", "yaml", "pyp", "zip"):
        os.mkfifo(made / f"pipe.{suffix}")
    links = {"zero.png": "/dev/zero", "zero.yaml": "/dev/zero", "lost.npy": "nowhere/heights.npy"}
    for name, target in {**links, "loop.npy": "loop.npy", "loop": "loop"}.items():
        (made / name).symlink_to(target)
    (made / "piped.yaml").write_text("height: heights.npy\nroughness: pipe.npy\n")
    # Maps and descriptions of a folder that are no files.
    for name in ("lost_map", "piped_description"):
        (made / name).mkdir()
        np.save(made / name / "height.npy", np.zeros((4, 8)))
    (made / "lost_map/roughness.png").symlink_to("nowhere.png")
    os.mkfifo(made / "piped_description/material.yaml")
    shards = write_data(made / "shards", constant(0.2), train=100, test=20, shards=1)
    (shards / "train-00000.npz").unlink()
    os.mkfifo(shards / "train-00000.npz")
    return made


def message(words: list[str]) -> str:
    """The message, or the report on standard output, of a command that fails."""
    done = call(words)
    assert done.code in (2, 3), done
    assert "Traceback" not in done.err
    lines = done.err[done.err.find("error: ") :].splitlines() if "error: " in done.err else []
    assert len(lines) <= 2, done
    assert all(text.isprintable() and len(text) < 600 for text in lines), done
    assert lines or done.out, done
    return "\n".join([*lines, done.out])


# Command lines, and what their message says.
CASES = [
    *((f"mbtf-gen inspect pipe.{suffix}".split(), "") for suffix in ("npy", "exr", "yaml", "pyp")),
    *((f"mbtf-gen inspect {name}".split(), "") for name in ("zero.png", "zero.yaml", "loop.npy", "lost.npy")),
    *((f"mbtf-gen inspect {name}".split(), "") for name in ("piped.yaml", "lost_map", "piped_description")),
    (["mbtf-gen", "plan", "heights.npy", "--config", "pipe.yaml"], ""),
    (["mbtf-gen", "import", "pipe.zip", "-o", "imported"], ""),
    (["mbtf-gen", "import", "heights.npy", "-o", "loop/imported"], ""),
    (["mbtf-gen", "publish", "shards", "--license", "CC0-1.0", "-o", "loop/card"], ""),
    (["mbtf-fit", "shards", "--steps", "1", "-o", "loop"], ""),
    (["mbtf-pipeline", "run", "pipe.yaml"], ""),
    (["mbtf-gen", "verify", "shards"], ""),
    (["mbtf-fit", "shards", "--steps", "1"], ""),
    # Control characters are escaped.
    (["mbtf-gen", "heights.npy", "--mesh", "9" * 5000], ""),
    (["mbtf-gen", "heights.npy", "--make-tileable", "\0"], ""),
    (["mbtf-gen", "heights.npy", "--set", "\x1b[2J=1"], ""),
    (["mbtf-gen", "two\nlines.npy"], "two\\nlines"),
    (["mbtf-gen", "x" * 5000], ""),
    # Arguments that mean something else.
    (["mbtf-gen", ""], "is empty"),
    (["mbtf-gen", "heights.npy", "-o", ""], "-o: is empty"),
    (["mbtf-gen", "heights.npy", "--output="], "--output: is empty"),
    (["mbtf-gen", "verify", "caf\udce9"], "not UTF-8"),
    (["mbtf-fit", "shards", "-o", "caf\udce9"], "not UTF-8"),
    # What no schema knows.
    (["mbtf-gen", "good/heights.npy", "--queries", "1e12/texel"], "raise output.shard_queries"),
    (["mbtf-gen", "good/heights.npy", "--slice", "4/3"], "4/3"),
    (["mbtf-gen", "reference", "good/heights.npy", "--view", "5,0"], "elevation"),
    (["mbtf-gen", "--queries", "5"], "no material"),
    (["mbtf-gen", "good/heights.npy", "-o", "lost_map"], "holds no data set"),
    (["mbtf-gen", "reference", "good/heights.npy", "-o", "lost_map"], "no pictures"),
    (["mbtf-pipeline", "report", "lost_map"], "contains no run"),
]


@pytest.mark.parametrize(("words", "essential"), CASES)
def test_special_inputs_are_refused(
    words: list[str], essential: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    assert essential in message(words)
