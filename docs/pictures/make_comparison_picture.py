"""Make docs/pictures/comparison.jpg from a finished quickstart run: the reference beside its fits.

Run after ``make demo``, from the repository's root: ``.venv/bin/python
docs/pictures/make_comparison_picture.py``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw, ImageFont

from mbtf_core.color import describe_exposure, to_display
from mbtf_pipeline.compare.image_files import read_picture

RUN = Path("out/quickstart/compare")
# A view at 35° under a grazing light, near and far.
SCENES = ("v2-l2-s1", "v2-l2-s2")
FITS = {"relief": "relief: known heights", "neumip": "neumip", "svbrdf": "svbrdf: no parallax"}
# Highlights are white, and the pattern in the light is still colored.
EXPOSURE = 2.3
GAP, TITLE = 6, 44
INK, PAPER = (30, 30, 30), (255, 255, 255)


def error_text(fit: dict[str, Any]) -> str:
    """Unexplained variance of the test queries, with its standard error."""
    unexplained = fit["splits"]["test"]["unexplained"]
    return f"unexplained variance {unexplained['value']:.2f} ± {unexplained['error']:.2f}"


def main() -> None:
    """Write the picture."""
    record = json.loads((RUN / "comparison.json").read_text())
    known = {scene["name"]: scene for scene in record["pictures"]}
    scenes = [known[name] for name in SCENES]
    columns = {"path-traced": "", **{title: error_text(record["test"][fit]) for fit, title in FITS.items()}}
    files = [
        [scene["references"]["query"]["file"], *(scene["fits"][fit]["file"] for fit in FITS)]
        for scene in scenes
    ]
    values = [[read_picture(RUN / file) for file in row] for row in files]
    size = values[0][0].shape[0]
    pitch = size + GAP
    out = Image.new("RGB", (len(values[0]) * pitch - GAP, TITLE + len(values) * pitch - GAP), PAPER)
    draw = ImageDraw.Draw(out)
    for column, (title, error) in enumerate(columns.items()):
        draw.text((column * pitch + 2, 2), title, INK, ImageFont.load_default(17))
        draw.text((column * pitch + 2, 24), error, INK, ImageFont.load_default(14))
    for row, scene in enumerate(scenes):
        top = TITLE + row * pitch
        for column, value in enumerate(values[row]):
            out.paste(Image.fromarray(to_display(value, EXPOSURE)), (column * pitch, top))
        label, at, font = (
            f"{scene['tiles_across']:g} tiles across",
            (8, top + size - 24),
            ImageFont.load_default(16),
        )
        left, high, right, low = draw.textbbox(at, label, font)
        draw.rectangle((left - 5, high - 4, right + 5, low + 4), fill=INK)
        draw.text(at, label, PAPER, font)
    out.save(Path(__file__).with_name("comparison.jpg"), quality=78)
    print(describe_exposure(EXPOSURE))


if __name__ == "__main__":
    main()
