"""Make docs/pictures/weaves.jpg: the named weaves of docs/how-to/make-cloth.md, path-traced and fitted.

Two commands make each fit: ``mbtf-gen material.yaml --quality draft --lights-per-path 4 -o shards`` and
``mbtf-fit shards --quality draft --set network.relief.places=16 --set network.relief.shadow_rays=true``.
Finished folders are kept in out/weaves. Prints errors, and contrasts of the fits (luminance Y, R - Y, B - Y)
over those of the references. From the repository's root, in an hour: ``.venv/bin/python
docs/pictures/make_weaves_picture.py``.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from make_contact_sheet import GAP, PAPER, ROOT, sheet
from numpy.typing import NDArray
from PIL import Image

from mbtf_core.color import to_display
from mbtf_core.data.shard_files import read_exr
from mbtf_core.images.read import LUMINANCE
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
RAYS = ("--set", "network.relief.places=16", "--set", "network.relief.shadow_rays=true")
QUERIES = {"u": 2, "sigma": 1, "omega_i": 3, "omega_o": 3}
EXPOSURE = 1.65
ACROSS = 2

F32 = NDArray[np.float32]


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


def contrasts(fit: F32, a: F32, b: F32) -> list[float]:
    """Standard deviations of a fit over those of its reference without noise; `a` and `b` are its halves."""

    def parts(value: F32) -> list[F32]:
        y = value @ np.array(LUMINANCE, np.float32)
        return [y, value[..., 0] - y, value[..., 2] - y]

    return [
        round(math.sqrt(x.var() / np.cov(y.ravel(), z.ravel())[0, 1]), 3)
        for x, y, z in zip(parts(fit), parts(a), parts(b), strict=True)
    ]


def pair(folder: Path) -> tuple[dict[str, float], Image.Image]:
    """Unexplained variance of the picture; reference and fit side by side."""
    shards, fit, compared = (str(folder / name) for name in ("shards", "fit", "compared"))
    run("mbtf-gen", str(folder / "material.yaml"), *DRAFT, "--lights-per-path", "4", "-o", shards)
    run("mbtf-fit", shards, *DRAFT, *RAYS, "-o", fit)
    (errors,) = run("mbtf-fit", "compare", fit, shards, *PICTURE, "-o", compared)["pictures"]
    stored = read_exr(folder / "compared" / f"query-tiles{TILES}.exr", (*QUERIES, "value_a", "value_b"))
    u, sigma, *directions = (stored[name].reshape(-1, size) for name, size in QUERIES.items())
    found = Material.load(fit).evaluate(u, sigma[:, 0], *directions)
    rows, columns = stored["value_a"].shape[-3:-1]
    found, a, b = (x.reshape(rows, columns, 3) for x in (found, stored["value_a"], stored["value_b"]))
    print(errors, contrasts(found, a, b))
    out = Image.new("RGB", (2 * columns + GAP, rows), PAPER)
    for number, value in enumerate((0.5 * (a + b), found)):
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
