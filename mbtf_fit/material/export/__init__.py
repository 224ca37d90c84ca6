"""Exports for other programs: textures as EXR, networks as a list of layers, half precision."""

from __future__ import annotations

from mbtf_fit.material.export.half import HalfError, to_half
from mbtf_fit.material.export.layers import LAYERS_NAME, write_layers
from mbtf_fit.material.export.textures import TEXTURES_NAME, write_textures

__all__ = ["LAYERS_NAME", "TEXTURES_NAME", "HalfError", "to_half", "write_layers", "write_textures"]
