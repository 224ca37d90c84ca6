"""Material maps → Mitsuba BSDF.

Lambert (``diffuse``) where nothing but base colour is given, else ``principled``. Maps are bilinear,
periodic, and linear; row 0 of an image is the side ``v → 1`` (the mesh's texture coordinates see to it).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from .material import Material


def _texture(value: Any) -> dict[str, Any]:
    """Bilinear periodic bitmap of an (H, W) or (H, W, 3) array of linear numbers."""
    pixels: NDArray[np.float32] = np.ascontiguousarray(value, np.float32)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(pixels),
        "raw": True,
        "filter_type": "bilinear",
        "wrap_mode": "repeat",
    }


def _colour(value: Any) -> dict[str, Any]:
    array = np.asarray(value, np.float64)
    if array.ndim >= 2:
        return _texture(array)
    return {"type": "rgb", "value": [float(c) for c in np.broadcast_to(array, 3)]}


def _scalar(value: Any) -> Any:
    array = np.asarray(value, np.float64)
    return _texture(array) if array.ndim >= 2 else float(array)


def bsdf_of(material: Material) -> dict[str, Any]:
    """Mitsuba dictionary of a material's BSDF."""
    if material.bsdf is not None:
        return dict(material.bsdf)
    if material.is_lambert:
        return {"type": "diffuse", "reflectance": _colour(material.basecolor)}
    return {
        "type": "principled",
        "base_color": _colour(material.basecolor),
        "roughness": _scalar(material.roughness),
        "metallic": _scalar(material.metallic),
        "specular": _scalar(material.specular),
    }
