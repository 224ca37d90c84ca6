"""Maps and constants → Mitsuba dictionaries of ``mbtf_surface``, the project's BSDF.

Maps are linear, and bilinear and periodic unless a texture of a mesh says otherwise. Row 0 of an image is the
side ``v → 1``, because of the texture coordinates of the tiles.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Any

import numpy as np

from mbtf_core.meshes.content import Texture, numbers_of
from mbtf_gen.tile.maps.material_file import REFLECTING, ROLES

# What may be beside a map, see :class:`~mbtf_core.meshes.content.MeshShape`.
CUTOFF = "opacity_cutoff"
# Mitsuba's texture coordinates have v down.
_FLIP = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 1.0], [0.0, 0.0, 1.0]])


def plugin_dictionary(given: Mapping[str, Any]) -> dict[str, Any]:
    """Mitsuba dictionary of ``mbtf_surface``.

    Parameters
    ----------
    given : parameters of the plugin: (H, W) or (H, W, 3) arrays of linear values, numbers, or colors (3,)
    """
    return {
        "type": "mbtf_surface",
        **{name: _parameter(v, name.endswith("color")) for name, v in given.items()},
    }


def in_use(maps: Mapping[str, Any], on: Collection[str]) -> dict[str, Any]:
    """Those of some maps and constants, by role, that the effects need that are on."""
    names = ["base_color", "roughness"]
    for effect in (*REFLECTING, "opacity"):
        weight = maps.get(effect)
        if effect in on and weight is not None and (effect != "metallic" or np.any(numbers_of(weight) > 0)):
            names += [name for name, role in ROLES.items() if role.effect == effect]
    return {name: maps[name] for name in (*names, CUTOFF) if name in maps}


def lobe_widths(maps: Mapping[str, Any]) -> Iterator[float]:
    """Widths in radians of the narrowest lobe of each role."""
    for name, role in ROLES.items():
        if role.lobe is not None and name in maps:
            yield role.lobe(float(np.min(numbers_of(maps[name]))))


def _parameter(value: Any, color: bool) -> Any:
    """Plugin parameter of a number or a color, or a bitmap of an array or of a texture."""
    array = numbers_of(value)
    if array.ndim < 2:
        constant = {"type": "rgb", "value": [float(c) for c in np.broadcast_to(array, 3)]}
        return constant if color else float(array)
    import mitsuba as mi

    texture = value[0] if isinstance(value, tuple) else Texture(array.astype(np.float32))
    pixels = np.ascontiguousarray(array if array.ndim == 3 else array[..., None], np.float32)
    to_uv = _FLIP @ np.vstack([texture.to_uv, (0.0, 0.0, 1.0)]) @ _FLIP
    placed = {} if np.array_equal(to_uv, np.eye(3)) else {"to_uv": mi.ScalarTransform3f(to_uv)}
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(pixels),
        "raw": True,
        "filter_type": "nearest" if texture.nearest else "bilinear",
        "wrap_mode": texture.wrap[0],
        **placed,
    }
