"""Make docs/pictures/comparison.jpg from a finished quickstart run: the reference beside its fits.

Run after ``make demo``, from the repository's root: ``.venv/bin/python
docs/pictures/make_comparison_picture.py``.
"""

from __future__ import annotations

import json
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from mbtf_core.color import auto_exposure, brightness, describe_exposure, to_display
from mbtf_pipeline.compare.image_files import read_picture

RUN = Path("out/quickstart/compare")
# A view at 35° under a grazing light, near and far.
SCENES = ("v2-l2-s1", "v2-l2-s2")
FITS = {"relief": "relief: known heights", "neumip": "neumip", "svbrdf": "svbrdf: no parallax"}
GAP, TITLE = 6, 26
INK, PAPER = (30, 30, 30), (255, 255, 255)


def main() -> None:
    """Write the picture."""
    known = {scene["name"]: scene for scene in json.loads((RUN / "comparison.json").read_text())["pictures"]}
    scenes = [known[name] for name in SCENES]
    files = [
        [scene["references"]["query"]["file"], *(scene["fits"][fit]["file"] for fit in FITS)]
        for scene in scenes
    ]
    values = [[read_picture(RUN / file) for file in row] for row in files]
    # One exposure for all.
    exposure = auto_exposure(brightness(row[0]) for row in values)
    size = values[0][0].shape[0]
    pitch = size + GAP
    out = Image.new("RGB", (len(values[0]) * pitch - GAP, TITLE + len(values) * pitch - GAP), PAPER)
    draw = ImageDraw.Draw(out)
    for column, title in enumerate(("path-traced", *FITS.values())):
        draw.text((column * pitch + 2, 3), title, INK, ImageFont.load_default(18))
    for row, scene in enumerate(scenes):
        top = TITLE + row * pitch
        for column, value in enumerate(values[row]):
            out.paste(Image.fromarray(to_display(value, exposure)), (column * pitch, top))
        label, at, font = (
            f"{scene['tiles_across']:g} tiles across",
            (8, top + size - 24),
            ImageFont.load_default(16),
        )
        left, high, right, low = draw.textbbox(at, label, font)
        draw.rectangle((left - 5, high - 4, right + 5, low + 4), fill=INK)
        draw.text(at, label, PAPER, font)
    out.save(Path(__file__).with_name("comparison.jpg"), quality=90)
    print(describe_exposure(exposure))


if __name__ == "__main__":
    main()
