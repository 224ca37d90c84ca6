"""Make docs/pictures/weaves.jpg: the named weaves of docs/how-to/make-cloth.md, path-traced and fitted.

Two commands make each fit: ``mbtf-gen material.yaml --quality draft --lights-per-path 4 -o shards`` and
``mbtf-fit shards --quality draft``.
Finished folders are kept in out/weaves. From the repository's root, in half an hour: ``.venv/bin/python
docs/pictures/make_weaves_picture.py``.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from make_contact_sheet import GAP, PAPER, ROOT, sheet
from PIL import Image

from mbtf_core.color import to_display
from mbtf_core.data.shard_files import read_exr
from mbtf_core.pictures import read_value
from mbtf_fit import Material

# Title and first lines of each material file.
WEAVES = {
    "plain": "{weave: plain, warp: light, weft: sand",
    "twill 2/1": "{weave: twill 2/1, warp: light, weft: rust",
    "satin 5/2": "{weave: satin 5/2, warp: light, weft: rust",
    "basket 2": "{weave: basket 2, warp: light, weft: sand",
    "herringbone": "{weave: herringbone, warp: dark, weft: light",
    "houndstooth": "{weave: houndstooth",
    "gingham": "{weave: gingham 4",
    "denim": "{weave: denim",
}
YARNS = {"light": "#e6dfd0", "sand": "#b59a6a", "rust": "#a4472c", "dark": "#23262e", "blue": "#26406e"}
NEEDED = {"houndstooth": ("dark", "light"), "gingham": ("rust", "light"), "denim": ("blue", "light")}
# Fewer, coarser fibers than those of the type.
YARN = "yarn: {type: cotton2, fibers: 20, radius: 3, flyaways: 0.4, width: 1}"
TILES = 3
# With fewer paths, the noise of the reference looks like fibers.
PICTURE = f"--view 55,-90 --light 35,140 --tiles-across {TILES} --size 144 --spp 400".split()
DRAFT = ("--quality", "draft")
QUERIES = ("u", "sigma", "omega_i", "omega_o")
EXPOSURE = 1.65
ACROSS = 2


def material(title: str, start: str) -> str:
    """Text of a material file."""
    names = NEEDED.get(title) or [name for name in YARNS if name in start]
    yarns = ", ".join(f"{name}: '{YARNS[name]}'" for name in names)
    return f"{start}, {YARN}, yarns: {{{yarns}}}}}\n"


def run(program: str, *words: str) -> Any:
    """What a program prints as JSON."""
    print(program, *words, flush=True)
    command = [sys.executable, "-m", program.replace("-", "_"), *words, "--json"]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)


def pair(folder: Path) -> tuple[dict[str, float], Image.Image]:
    """Unexplained variance of the picture; reference and fit side by side."""
    shards, fit, compared = (str(folder / name) for name in ("shards", "fit", "compared"))
    run("mbtf-gen", str(folder / "material.yaml"), *DRAFT, "--lights-per-path", "4", "-o", shards)
    run("mbtf-fit", shards, *DRAFT, "-o", fit)
    (errors,) = run("mbtf-fit", "compare", fit, shards, *PICTURE, "-o", compared)["pictures"]
    print(errors, flush=True)
    path = folder / "compared" / f"query-tiles{TILES}.exr"
    reference, queries = read_value(path), read_exr(path, QUERIES)
    flat = [queries[name].reshape(-1, *queries[name].shape[2:]) for name in QUERIES]
    found = Material.load(fit).evaluate(*flat).reshape(reference.shape)
    rows, columns = reference.shape[:2]
    out = Image.new("RGB", (2 * columns + GAP, rows), PAPER)
    for number, value in enumerate((reference, found)):
        out.paste(Image.fromarray(to_display(value, EXPOSURE)), (number * (columns + GAP), 0))
    return errors["unexplained"], out


def main() -> None:
    """Write the picture."""
    pictures = {}
    for title, start in WEAVES.items():
        folder = ROOT / "out" / "weaves" / title.replace("/", "-").replace(" ", "_")
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "material.yaml").write_text(material(title, start))
        error, picture = pair(folder)
        pictures[f"{title}: {error['value']:.3f} ± {error['error']:.3f}"] = picture
    sheet(pictures, ACROSS).save(Path(__file__).with_name("weaves.jpg"), quality=85)


if __name__ == "__main__":
    main()
