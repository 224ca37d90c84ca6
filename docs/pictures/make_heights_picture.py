"""Draws the heights that ``neumip+`` learned beside those of the geometry, and prints their correlations.

From the repository's root, after ``benchmarks/relief.py --out FOLDER --time 30s``:
``.venv/bin/python docs/pictures/make_heights_picture.py FOLDER [MATERIAL ...]``. The picture shows the first
six: known heights above, learned ones below, each from its lowest (black) to its highest point (white).
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mbtf_core.data.dataset import Dataset
from mbtf_core.images.resample import resample
from mbtf_fit import Material

OUT = Path(__file__).parent / "learned_heights.png"
FIT = "neumip+-30s-0"
SHOWN, SIZE, GAP = 6, 160, 6


def gray(heights: NDArray[np.float32]) -> Image.Image:
    """Heights as a picture of a fixed size."""
    scaled = (heights - heights.min()) / max(float(np.ptp(heights)), 1e-9)
    picture = Image.fromarray((255 * scaled).astype(np.uint8))
    return picture.resize((SIZE, SIZE), Image.Resampling.LANCZOS)


def main() -> int:
    if len(sys.argv) < 2:
        print(__doc__, file=sys.stderr)
        return 2
    folder = Path(sys.argv[1])
    names = sys.argv[2:] or sorted(path.parent.name for path in folder.glob(f"*/{FIT}"))
    pictures = []
    for name in names:
        learned = Material.load(folder / name / FIT).model.weights()["surface.heights"][..., 0].numpy()
        geometry = Dataset.open(folder / name / "shards").geometry()
        assert geometry is not None
        known = np.asarray(resample(geometry.heights, *learned.shape), np.float32)
        correlation = np.corrcoef(learned.ravel(), known.ravel())[0, 1]
        print(f"{name}: correlation {correlation:.2f}, RMS {learned.std():.4f} of {known.std():.4f}")
        pictures.append([gray(known), gray(learned)])
    pictures = pictures[:SHOWN]
    out = Image.new("L", (len(pictures) * (SIZE + GAP) - GAP, 2 * SIZE + GAP), 255)
    for column, pair in enumerate(pictures):
        for row, picture in enumerate(pair):
            out.paste(picture, (column * (SIZE + GAP), row * (SIZE + GAP)))
    out.save(OUT, optimize=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
