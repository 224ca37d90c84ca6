"""What an image file says about its colors and its orientation, as far as that is well defined."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

ColorSpace = Literal["srgb", "linear"]

_ORIENTATION = 0x0112
# Stored gammas are rounded to 1e-5; these are 1/2.2, which stands for sRGB, and 1.
_SRGB_GAMMA, _LINEAR_GAMMA, _SLACK = 0.45455, 1.0, 0.005


@dataclass(frozen=True)
class Tags:
    """Claims of a file about itself.

    Attributes
    ----------
    space : color space, where the file names one of the two that are known
    foreign : what it claims otherwise, in words, such as ``color profile 'Display P3'``; None without
    orientation : EXIF orientation, 1 upright
    """

    space: ColorSpace | None = None
    foreign: str | None = None
    orientation: int = 1


NO_TAGS = Tags()


def tags_of(info: Mapping[Any, Any], exif: Mapping[int, Any]) -> Tags:
    """Tags from what Pillow read of a file.

    Of several claims the profile comes before the ``sRGB`` chunk and that before ``gAMA``, as the PNG
    specification (third edition, 4.3) has it. A gamma of 1 means linear, 1/2.2 sRGB; a profile whose
    description names sRGB means sRGB. Other profiles and gammas are reported, not applied.
    """
    orientation = exif.get(_ORIENTATION, 1)
    turned = orientation if isinstance(orientation, int) and 1 <= orientation <= 8 else 1
    if info.get("icc_profile"):
        name = _profile_name(info["icc_profile"])
        srgb = "srgb" in name.lower()
        return Tags("srgb" if srgb else None, None if srgb else f"color profile '{name}'", turned)
    if "srgb" in info:
        return Tags("srgb", None, turned)
    gamma = info.get("gamma")
    if isinstance(gamma, float) and gamma > 0:
        if abs(gamma - _SRGB_GAMMA) < _SLACK:
            return Tags("srgb", None, turned)
        if abs(gamma - _LINEAR_GAMMA) < _SLACK:
            return Tags("linear", None, turned)
        return Tags(None, f"gamma of {gamma:g}", turned)
    return Tags(orientation=turned)


def _profile_name(profile: bytes) -> str:
    """Description of an ICC profile, one line."""
    from PIL import ImageCms

    try:
        text = ImageCms.getProfileDescription(ImageCms.ImageCmsProfile(io.BytesIO(profile)))
    except Exception:  # a damaged profile may make the library raise anything
        return "unreadable"
    printable = "".join(c for c in " ".join(text.split()) if c.isprintable())
    return printable[:60] or "without a name"
