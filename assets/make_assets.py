#!/usr/bin/env python3
"""Make the small materials of this folder, bit for bit, from formulas alone.

    python assets/make_assets.py [FOLDER [MATERIAL ...]]

A displaced material is a folder with ``height.exr`` (float, heights in tile widths), and mostly
``base_color.png`` (sRGB) and ``roughness.png`` (linear), all 256 × 256 and periodic; a ``material.yaml``
has constants, such as another refractive index than 1.5. The scales are a mesh. Random numbers come from
an integer hash and every result is rounded to a coarse grid (heights to 2^-14 tile widths, colors to 8 bits),
so that neither the version of a library nor the last bit of a sine shows in the files. Row 0 of every image
is the side v → 1.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

from make import scales
from make.cliff_rock import cliff_rock
from make.insulation_foam import insulation_foam
from make.metals import brushed_aluminum, coated_copper
from make.straight_wool import straight_wool
from make.tile import Material, write
from make.turtle_shell import turtle_shell
from make.twisted_wool import twisted_wool

MATERIALS: dict[str, Callable[[], Material]] = {
    "twisted_wool": twisted_wool,
    "straight_wool": straight_wool,
    "turtle_shell": turtle_shell,
    "cliff_rock": cliff_rock,
    "insulation_foam": insulation_foam,
    "coated_copper": coated_copper,
    "brushed_aluminum": brushed_aluminum,
}
SCALES = "fish_scales"


def main(arguments: list[str]) -> None:
    """Write the named materials, by default all, below a folder, by default the one of this script."""
    target = Path(arguments[0]) if arguments else Path(__file__).resolve().parent
    for name in arguments[1:] or (*MATERIALS, SCALES):
        if name == SCALES:
            scales.write(target / name)
        else:
            write(MATERIALS[name](), target / name)


if __name__ == "__main__":
    main(sys.argv[1:])
