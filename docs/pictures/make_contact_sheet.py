"""Make docs/pictures/contact_sheet.png: surfaces of assets/ and a knit, one tile across.

One run of ``mbtf-gen reference`` renders each picture; its command is printed. Labels are added here.
Finished pictures are kept in out/contact_sheet. From the repository's root, in ten minutes:
``.venv/bin/python docs/pictures/make_contact_sheet.py``.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

ROOT = Path(__file__).parents[2]
SURFACES = (
    *("twisted_wool", "straight_wool", "turtle_shell", "cliff_rock"),
    *("insulation_foam", "coated_copper", "fish_scales"),
)
# Paths per pixel; those of fibers take long.
MATERIALS = {**dict.fromkeys(SURFACES, 256), "stockinette": 192}
VIEW = "--view 50,-90 --light 35,140 --tiles-across 1"
SIZE, ACROSS = 144, 4
GAP, TITLE = 6, 24
INK, PAPER = (30, 30, 30), (255, 255, 255)


def render(material: str, options: str, size: int, spp: int, output: Path) -> Image.Image:
    """One picture of a material, (size, size) pixels, kept in a folder.

    Raises
    ------
    subprocess.CalledProcessError
        If the program fails.
    """
    words = ["reference", material, *shlex.split(options)]
    words += ["--size", str(size), "--spp", str(spp), "--kind", "pixel", "-o", str(output)]
    print("mbtf-gen", *words, flush=True)
    command = [sys.executable, "-m", "mbtf_gen", *words, "--quiet"]
    subprocess.run(command, check=True, cwd=ROOT, stdout=subprocess.DEVNULL)
    (picture,) = output.glob("*.png")
    with Image.open(picture) as image:
        return image.convert("RGB")


def sheet(pictures: dict[str, Image.Image], across: int) -> Image.Image:
    """Pictures with titles above, so many across."""
    first = next(iter(pictures.values()))
    wide, high = first.width + GAP, first.height + GAP + TITLE
    out = Image.new("RGB", (across * wide - GAP, -(-len(pictures) // across) * high - GAP), PAPER)
    draw, font = ImageDraw.Draw(out), ImageFont.load_default(15)
    for number, (title, picture) in enumerate(pictures.items()):
        left, top = number % across * wide, number // across * high
        draw.text((left + 2, top + 3), title, INK, font)
        out.paste(picture, (left, top + TITLE))
    return out


def main() -> None:
    """Write the sheet."""
    pictures = {
        name.replace("_", " "): render(f"assets/{name}", VIEW, SIZE, spp, ROOT / "out/contact_sheet" / name)
        for name, spp in MATERIALS.items()
    }
    sheet(pictures, ACROSS).save(Path(__file__).with_name("contact_sheet.png"), optimize=True)


if __name__ == "__main__":
    main()
