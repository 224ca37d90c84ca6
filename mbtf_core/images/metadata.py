"""Color space and orientation that an image file declares."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

ColorSpace = Literal["srgb", "linear"]

# Stored gammas of the known spaces (sRGB: 1/2.2), and the tolerance of their comparison.
_GAMMAS: dict[ColorSpace, float] = {"srgb": 0.45455, "linear": 1.0}
_SLACK = 0.005


@dataclass(frozen=True)
class Tags:
    """Metadata of an image file.

    Attributes
    ----------
    space : declared color space, if supported
    foreign : unsupported declaration, such as ``color profile 'Display P3'``
    orientation : of EXIF; 1 is upright
    """

    space: ColorSpace | None = None
    foreign: str | None = None
    orientation: int = 1


NO_TAGS = Tags()


def tags_of(info: Mapping[Any, Any], exif: Mapping[int, Any]) -> Tags:
    """Tags from the metadata that Pillow read.

    The profile takes precedence over the ``sRGB`` chunk, and that over ``gAMA`` (PNG specification, third
    edition, 4.3). A gamma of 1 means linear, 1/2.2 sRGB; a profile whose description names sRGB means sRGB.
    Other profiles and gammas are reported, not applied.
    """
    from PIL import ExifTags

    orientation = exif.get(ExifTags.Base.Orientation, 1)
    turned = orientation if orientation in range(1, 9) else 1
    space: ColorSpace | None = None
    foreign = None
    gamma = info.get("gamma")
    if info.get("icc_profile"):
        name = _profile_name(info["icc_profile"])
        space, foreign = ("srgb", None) if "srgb" in name.lower() else (None, f"color profile '{name}'")
    elif "srgb" in info:
        space = "srgb"
    elif isinstance(gamma, float) and gamma > 0:
        space = next((s for s, g in _GAMMAS.items() if abs(gamma - g) < _SLACK), None)
        foreign = None if space else f"gamma of {gamma:g}"
    return Tags(space, foreign, turned)


def _profile_name(profile: bytes) -> str:
    """Description of an ICC profile, one line."""
    from PIL import ImageCms

    try:
        text = ImageCms.getProfileDescription(ImageCms.ImageCmsProfile(io.BytesIO(profile)))
    except Exception:  # a damaged profile may make the library raise anything
        return "unreadable"
    printable = "".join(c for c in " ".join(text.split()) if c.isprintable())
    return printable[:60] or "without a name"
