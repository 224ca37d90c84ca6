"""Constants of the models, shared by the PyTorch models, the C kernel and the Mitsuba plugin."""

from __future__ import annotations

from mbtf_fit.config import EncodingSection

# Slope of leaky-relu below zero.
LEAK = 0.01
# Offset in tile widths per unit of the offset network's output.
OFFSET_SCALE = 0.1
# Cosine below which the offset no longer grows towards grazing views.
GRAZING = 0.6
# Rec.601 YUV → RGB, one row per color, as in NeuMIP's published code.
RGB_OF_YUV = ((1.0, 0.0, 1.13983), (1.0, -0.39465, -0.58060), (1.0, 2.03211, 0.0))
# Least value of the gate, so that its gradient never vanishes.
GATE = 0.1


def encoded_size(coordinates: int, bands: int, options: EncodingSection) -> int:
    """Numbers that encode so many coordinates."""
    return coordinates * (2 * bands + options.raw) if bands else coordinates


def direction_size(options: EncodingSection) -> int:
    """Numbers that encode a direction."""
    return encoded_size(3 if options.direction_xyz else 2, options.direction, options)


def directions_size(options: EncodingSection) -> int:
    """Numbers that encode light and view."""
    return 2 * direction_size(options) + (6 if options.half_vector else 0)


def position_size(options: EncodingSection) -> int:
    """Numbers that encode a position."""
    return encoded_size(2, options.position, options) if options.position else 0
