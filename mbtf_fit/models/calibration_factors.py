"""Calibration factors of a value by level and elevation of light and view, interpolated in small tables.

:mod:`mbtf_fit.training.calibration` derives and fits the tables.
"""

from __future__ import annotations

import torch
from torch import Tensor

# Knots of the cosine: 0, 1/16, ..., 1.
KNOTS = 17


def interpolate_factors(table: Tensor, level: Tensor, cosine: Tensor) -> Tensor:
    """Factors (n, 3) of a table (levels, knots, 3) at fractional levels (n,) and cosines (n,): bilinear
    between levels and knots, which are equidistant in [0, 1]."""
    last = max(1, table.shape[0] - 1)
    # An image whose rows are levels, in the coordinates of grid_sample: corners at -1 and 1.
    position = torch.stack([2.0 * cosine - 1.0, (2.0 / last) * level - 1.0], -1)
    found = torch.nn.functional.grid_sample(
        table.permute(2, 0, 1)[None], position[None, :, None], padding_mode="border", align_corners=True
    )
    return found[0, :, :, 0].T
