"""Description of a cloth, as plain data and as text."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from mbtf_gen.tile.fiber_tile import FiberTile


def inspect_fibers(fibers: FiberTile) -> dict[str, Any]:
    """Collect the statistics of a cloth.

    Parameters
    ----------
    fibers : FiberTile

    Returns
    -------
    dict
        Plain data; lengths are in tile widths.
    """
    radii = np.concatenate([curve.control[:, 3] for curve in fibers.curves])
    slopes = [curve.at(np.arange(4 * len(curve.windows())) / 4.0)[1] for curve in fibers.curves]
    length = sum(float(np.linalg.norm(slope[:, :3], axis=1).sum()) / 4.0 for slope in slopes)
    volume = np.pi * float(np.mean(radii**2)) * length / (fibers.aspect * fibers.thickness)
    return {
        "aspect": fibers.aspect,
        "fibers": {
            "count": len(fibers.curves),
            "segments": fibers.segments,
            "thickness": fibers.thickness,
            "radius": [float(radii.min()), float(radii.max())],
            "length": length,
            "share_of_volume": volume,
        },
        "colors": fibers.colors.tolist(),
        "scattering": asdict(fibers.scattering),
    }


def fiber_text(found: dict[str, Any], name: str) -> str:
    """The data of :func:`inspect_fibers` as text for people."""
    f, s = found["fibers"], found["scattering"]
    low, high = f["radius"]
    radius = f"{low:.3g}" if low == high else f"{low:.3g} .. {high:.3g}"
    colors = "; ".join(" ".join(f"{c:.2f}" for c in color) for color in found["colors"])
    return "\n".join(
        [
            f"{name}: tile 1 x {found['aspect']:.4g}, fibers, resolution {found['resolution']}",
            "",
            f"fibers      {f['count']:,} of {f['segments']:,} segments, radius {radius}, together "
            f"{f['length']:.3g} tile widths long",
            f"cloth       {f['thickness']:.3g} tile widths thick, {f['share_of_volume']:.0%} of it fibers",
            f"color       {colors}",
            f"scattering  roughness {s['roughness']:g} along and {s['azimuthal_roughness']:g} around the "
            f"fiber, scales tilted by {s['scale_tilt']:g}°, index of refraction {s['ior']:g}",
            *(f"warning     {text}" for text in found["warnings"]),
        ]
    )
