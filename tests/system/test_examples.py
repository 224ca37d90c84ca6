"""The notebooks of ``examples/`` run: from maps to a rendered ball, and a network of one's own; and so do the
pages on the use from Python."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from conftest import RunPython
from PIL import Image
from support.paths import ROOT

EXAMPLES = ROOT / "examples"
# Of the cells tagged `parameters`: seconds in place of a minute.
SMALL = {
    "maps_to_ball": 'RESOLUTION, QUERIES, SECONDS, SIZE, SPP = 16, "50/texel", 1.0, 48, 4',
    "train_your_own": 'RESOLUTION, QUERIES, EPOCHS, WIDTH = 8, "100/texel", 40, 32',
}


def cells(notebook: Path) -> list[dict[str, Any]]:
    """Code cells in order."""
    stored = json.loads(notebook.read_text(encoding="utf-8"))
    assert stored["nbformat"] == 4
    return [cell for cell in stored["cells"] if cell["cell_type"] == "code"]


def names(source: str) -> set[str]:
    """Names that the lines of a parameter cell set."""
    left = [line.partition("=")[0] for line in source.splitlines() if "=" in line and line[0] != "#"]
    return {name.strip() for part in left for name in part.split(",")}


def run_notebook(name: str, tmp_path: Path, run_python: RunPython) -> tuple[Path, str]:
    """Its folder, and what it printed."""
    sources = []
    for cell in cells(EXAMPLES / f"{name}.ipynb"):
        source = "".join(cell["source"])
        if "parameters" in cell["metadata"].get("tags", []):
            assert names(source) == names(SMALL[name])
            source = SMALL[name]
        sources.append(source)
    assert SMALL[name] in sources
    (tmp_path / "assets").symlink_to(ROOT / "assets")
    folder = tmp_path / "examples"
    folder.mkdir()
    (folder / "ball.xml").write_bytes((EXAMPLES / "ball.xml").read_bytes())
    script = folder / "cells.py"
    script.write_text(f"import os\nos.chdir({str(folder)!r})\n" + "\n".join(sources), encoding="utf-8")
    done = run_python(str(script), MPLBACKEND="Agg")
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


def test_the_notebook_trains_a_network(tmp_path: Path, run_python: RunPython) -> None:
    _, printed = run_notebook("train_your_own", tmp_path, run_python)
    numbers = r"noise-free MSE (\S+) .*with noise (\S+)\n.*values (\S+)\nunexplained variance (\S+) "
    found = re.search(numbers, printed)
    assert found is not None, printed
    error, noisy, floor, unexplained = map(float, found.groups())
    # Both errors differ by the noise alone.
    assert floor > 0
    assert abs(noisy - error - floor) < 0.05 * noisy
    assert 0 < unexplained < 0.9


def test_the_notebook_renders_a_ball(tmp_path: Path, run_python: RunPython) -> None:
    folder, printed = run_notebook("maps_to_ball", tmp_path, run_python)
    assert "unexplained variance" in printed
    ball = np.asarray(Image.open(folder / "ball.png").convert("RGB")).astype(float)
    assert ball.shape == (48, 48, 3)
    # Above are the gray sky and the ball before it, below the floor.
    assert ball[0].std() < 2
    assert 20 < ball[15:30, 18:32].mean() < 240
    assert ball[15:30, 18:32].std() > 5
    assert ball[30:].std() > 5


def test_the_pages_on_python_run(tmp_path: Path, run_python: RunPython) -> None:
    """Their blocks one after the other, at small sizes; the model that knows the surface has less error."""
    pages = [ROOT / "docs/how-to" / name for name in ("use-python.md", "read-the-data.md")]
    blocks = re.compile(r"```python\n(.*?)```", re.DOTALL)
    text = "\n".join(block for page in pages for block in blocks.findall(page.read_text(encoding="utf-8")))
    for large, small in (
        ('"resolution": 64, "train": "50/texel"', '"resolution": 16, "test": 1024, "test_spp": 16'),
        ('"time": "10s"', '"steps": 60, "batch": 2048'),
        ("rows=128, columns=128", "rows=24, columns=24"),
        ("spp=64", "spp=8"),
        ("small/", "wool_shards/"),
    ):
        assert large in text
        text = text.replace(large, small)
    (tmp_path / "assets").symlink_to(ROOT / "assets")
    script = tmp_path / "pages.py"
    main = "\n    ".join(
        ["if __name__ == '__main__':", f"import os; os.chdir({str(tmp_path)!r})", *text.splitlines()]
    )
    script.write_text(main, encoding="utf-8")
    done = run_python("-W", "error::UserWarning", str(script), MPLBACKEND="Agg")
    assert done.returncode == 0, done.stderr
    unexplained, difference, verdict, error, *_ = done.stdout.splitlines()
    assert 0 < float(unexplained.split()[0]) < 1
    assert float(difference.split()[-2]) < 0
    assert float(verdict.rpartition("p = ")[2]) < 1e-3
    assert "±" in error
    assert np.asarray(Image.open(tmp_path / "pair.png").convert("RGB")).shape == (24, 48, 3)
