"""Make docs/pictures/comparison.png from a finished quickstart run.

The reference is on the left of each seam, the fitted material on the right.

Run after ``make demo``, from the repository's root: ``.venv/bin/python
docs/pictures/make_comparison_picture.py``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

RUN = Path("out/quickstart/compare/pictures")
SCENES = ("v1-l1-s1", "v2-l1-s1", "v2-l2-s1", "v2-l1-s2")
GAP = 6


def split(scene: str) -> NDArray[np.uint8]:
    """One picture: the reference on the left, the fit on the right, a white seam between them."""
    reference, fit = (
        np.asarray(Image.open(RUN / f"{scene}-{name}.png").convert("RGB"))
        for name in ("reference-query", "fit-relief")
    )
    middle = reference.shape[1] // 2
    out = np.concatenate([reference[:, :middle], fit[:, middle:]], axis=1)
    out[:, middle - 1 : middle + 1] = 255
    return out


def main() -> None:
    """Write the picture."""
    panels = [split(scene) for scene in SCENES]
    gap = np.full((panels[0].shape[0], GAP, 3), 255, np.uint8)
    row = [part for panel in panels for part in (panel, gap)][:-1]
    picture = Image.fromarray(np.concatenate(row, axis=1))
    picture.save(Path(__file__).with_name("comparison.png"), optimize=True)


if __name__ == "__main__":
    main()
