"""Make docs/pictures/weaves.png: the named weaves of docs/how-to/make-cloth.md, path-traced from above.

From the repository's root, in ten minutes: ``.venv/bin/python docs/pictures/make_weaves_picture.py``.
"""

from __future__ import annotations

from pathlib import Path

from make_contact_sheet import ROOT, render, sheet

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
SIZE, SPP, ACROSS = 200, 96, 4


def material(title: str, start: str) -> str:
    """Text of a material file."""
    names = NEEDED.get(title) or [name for name in YARNS if name in start]
    yarns = ", ".join(f"{name}: '{YARNS[name]}'" for name in names)
    return f"{start}, {YARN}, yarns: {{{yarns}}}}}\n"


def main() -> None:
    """Write the picture."""
    pictures = {}
    for title, start, tiles in WEAVES:
        folder = ROOT / "out" / "weaves" / title.replace("/", "-").replace(" ", "_")
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "material.yaml").write_text(material(title, start))
        options = f"--view 90,-90 --light 50,140 --tiles-across {tiles}"
        pictures[title] = render(str(folder / "material.yaml"), options, SIZE, SPP, folder / "picture")
    # Few colors keep the file small.
    sheet(pictures, ACROSS).quantize(128).save(Path(__file__).with_name("weaves.png"), optimize=True)


if __name__ == "__main__":
    main()
