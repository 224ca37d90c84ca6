"""The line of the viewer's page that says what is shown, and how far the picture is."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from mbtf_fit.viewer.page import __file__ as page_file

MAIN = Path(page_file).parent / "page" / "main.js"
STUBS = """
const clamp = (x, low, high) => Math.min(Math.max(x, low), high), FRAMES = 64;
const tilesText = (tiles) => `${tiles} tiles`;
const viewer = {
  renderer: { canvas: { width: 512 }, means: { full: MEAN } },
  camera: { tiles_across: 8 },
  material: { content: { finest: 7 } },
  full: 3,
};
console.log(statusLine(viewer));
"""


@pytest.mark.skipif(shutil.which("node") is None, reason="no node; to enable: install Node.js")
@pytest.mark.parametrize(
    ("mean", "progress"),
    [
        (None, "preview in low resolution"),
        ({"frames": 0, "row": 0, "height": 200}, "preview in low resolution"),
        ({"frames": 0, "row": 50, "height": 200}, "drawing in full resolution: 25% of 3 s"),
        ({"frames": 5, "row": 0, "height": 200}, "smoothing edges: frame 5 of 64, 3 s each"),
        ({"frames": 64, "row": 0, "height": 200}, "picture complete"),
    ],
)
def test_the_status_names_the_phase_and_the_texels_of_a_pixel(
    mean: dict[str, int] | None, progress: str
) -> None:
    functions = MAIN.read_text().split("// Until the browser")[0]
    script = functions + STUBS.replace("MEAN", json.dumps(mean))
    done = subprocess.run(["node", "-e", script], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == f"8 tiles across, a pixel is 2 texels wide (level 6.0 of 7), {progress}"
