"""Make docs/pictures/contact_sheet.png: every material of assets/ as a close view and from afar.

One run of ``mbtf-gen reference`` renders each picture; its command is printed. Labels are added here.
From the repository's root, in half an hour: ``.venv/bin/python docs/pictures/make_contact_sheet.py``.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

# In blocks of four across.
MATERIALS = (
    *("twisted_wool", "straight_wool", "turtle_shell", "cliff_rock"),
    *("insulation_foam", "basket_weave", "twill_silk", "stockinette"),
)
ACROSS = 4
# Caption of each row, and the options of its pictures.
ROWS = (
    ("one tile across, view at 55°, light at 40°", "--view 55,-90 --light 40,140 --tiles-across 1"),
    ("two tiles across, view at 40°, grazing light at 15°", "--view 40,-90 --light 15,150 --tiles-across 2"),
)
SIZE, SPP = 200, 256
GAP, TITLE, CAPTION = 6, 26, 22
INK, PAPER = (30, 30, 30), (255, 255, 255)


def render(material: str, options: str, size: int, spp: int) -> Image.Image:
    """One picture of a material, (size, size) pixels.

    Raises
    ------
    subprocess.CalledProcessError
        If the program fails.
    """
    words = ["reference", material, *shlex.split(options)]
    words += ["--size", str(size), "--spp", str(spp), "--kind", "pixel"]
    print("mbtf-gen", *words, flush=True)
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "pictures"
        root = Path(__file__).parents[2]
        command = [sys.executable, "-m", "mbtf_gen", *words, "-o", str(output), "--quiet"]
        subprocess.run(command, check=True, cwd=root, stdout=subprocess.DEVNULL)
        (picture,) = output.glob("*.png")
        with Image.open(picture) as image:
            return image.convert("RGB")


def main() -> None:
    """Write the sheet."""
    pitch = SIZE + GAP
    block = TITLE + len(ROWS) * (CAPTION + pitch)
    sheet = Image.new("RGB", (ACROSS * pitch - GAP, len(MATERIALS) // ACROSS * block - GAP), PAPER)
    draw = ImageDraw.Draw(sheet)
    for number, material in enumerate(MATERIALS):
        column, above = number % ACROSS, number // ACROSS * block
        title = material.replace("_", " ")
        draw.text((column * pitch + 2, above + 2), title, INK, ImageFont.load_default(18))
        for row, (caption, options) in enumerate(ROWS):
            top = above + TITLE + row * (CAPTION + pitch)
            if column == 0:
                draw.text((2, top + 2), caption, INK, ImageFont.load_default(14))
            picture = render(f"assets/{material}", options, SIZE, SPP)
            sheet.paste(picture, (column * pitch, top + CAPTION))
    sheet.save(Path(__file__).with_name("contact_sheet.png"), optimize=True)


if __name__ == "__main__":
    main()
