"""Maps and constants → Mitsuba dictionaries of ``mbtf_surface``, the project's BSDF.

Maps are bilinear, periodic, and linear. Row 0 of an image is the side ``v → 1``, because of the texture
coordinates of the tiles.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np


def plugin_dictionary(given: Mapping[str, Any]) -> dict[str, Any]:
    """Mitsuba dictionary of ``mbtf_surface``.

    Parameters
    ----------
    given : mapping of str to array or float
        Parameters of the plugin: (H, W) or (H, W, 3) arrays of linear values, numbers, or colors (3,).

    Returns
    -------
    dict
    """
    return {
        "type": "mbtf_surface",
        **{name: _parameter(v, name.endswith("color")) for name, v in given.items()},
    }


def reflectance(base_color: Any, roughness: Any = None, metallic: Any = None) -> dict[str, Any]:
    """Mitsuba dictionary of a Lambert surface, or of a glossy one where the roughness is given."""
    given = {"base_color": base_color}
    if roughness is not None:
        metals = metallic is not None and np.any(np.asarray(metallic) > 0)
        given |= {"roughness": roughness, "specular": 0.5, **({"metallic": metallic} if metals else {})}
    return plugin_dictionary(given)


def _parameter(value: Any, color: bool) -> Any:
    """Plugin parameter of a number or a color, or a bitmap of an array."""
    array = np.asarray(value, np.float64)
    if array.ndim < 2:
        constant = {"type": "rgb", "value": [float(c) for c in np.broadcast_to(array, 3)]}
        return constant if color else float(array)
    import mitsuba as mi

    pixels = np.ascontiguousarray(array if array.ndim == 3 else array[..., None], np.float32)
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(pixels),
        "raw": True,
        "filter_type": "bilinear",
        "wrap_mode": "repeat",
    }
