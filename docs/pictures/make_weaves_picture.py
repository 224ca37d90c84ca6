"""Make docs/pictures/weaves.png: the named weaves of docs/how-to/make-cloth.md, path-traced from above.

From the repository's root, in twenty minutes: ``.venv/bin/python docs/pictures/make_weaves_picture.py``.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from make_contact_sheet import GAP, INK, PAPER, TITLE, render
from PIL import Image, ImageDraw, ImageFont

# Title and first lines of each material file, and tiles across its picture.
WEAVES = (
    ("plain", "{weave: plain, warp: light, weft: sand", 6),
    ("twill 2/1", "{weave: twill 2/1, warp: light, weft: rust", 4),
    ("satin 5/2", "{weave: satin 5/2, warp: light, weft: rust", 2),
    ("basket 2", "{weave: basket 2, warp: light, weft: sand", 3),
    ("herringbone", "{weave: herringbone, warp: dark, weft: light", 1),
    ("houndstooth", "{weave: houndstooth", 2),
    ("gingham", "{weave: gingham 4", 2),
    ("denim", "{weave: denim", 3),
)
YARNS = {"light": "#e6dfd0", "sand": "#b59a6a", "rust": "#a4472c", "dark": "#23262e", "blue": "#26406e"}
NEEDED = {"houndstooth": ("dark", "light"), "gingham": ("rust", "light"), "denim": ("blue", "light")}
# Fewer, coarser fibers than those of the type.
YARN = "yarn: {type: cotton2, fibers: 20, radius: 3, flyaways: 0.4, width: 1}"
SIZE, SPP, ACROSS = 128, 256, 4


def material(title: str, start: str) -> str:
    """Text of a material file."""
    names = NEEDED.get(title) or [name for name in YARNS if name in start]
    yarns = ", ".join(f"{name}: '{YARNS[name]}'" for name in names)
    return f"{start}, {YARN}, yarns: {{{yarns}}}}}\n"


def main() -> None:
    """Write the picture."""
    pitch = SIZE + GAP
    sheet = Image.new("RGB", (ACROSS * pitch - GAP, len(WEAVES) // ACROSS * (TITLE + pitch) - GAP), PAPER)
    draw = ImageDraw.Draw(sheet)
    with tempfile.TemporaryDirectory() as folder:
        for number, (title, start, tiles) in enumerate(WEAVES):
            file = Path(folder) / "material.yaml"
            file.write_text(material(title, start))
            left, top = number % ACROSS * pitch, number // ACROSS * (TITLE + pitch)
            draw.text((left + 2, top + 2), title, INK, ImageFont.load_default(16))
            options = f"--view 90,-90 --light 50,140 --tiles-across {tiles}"
            sheet.paste(render(str(file), options, SIZE, SPP), (left, top + TITLE))
    # Few colors keep the file small.
    sheet.quantize(128).save(Path(__file__).with_name("weaves.png"), optimize=True)


if __name__ == "__main__":
    main()
