"""The learned shading frames of `zeltner2024`."""

from __future__ import annotations

from typing import Any, cast

import torch

from mbtf_fit import ops
from mbtf_fit.pytorch.operations import PYTORCH


def test_directions_are_read_in_the_frame_of_normal_and_tangent() -> None:
    """A frame built the other way round, by turning the tile's, gives back its own axes as x, y and z."""
    generator = torch.Generator().manual_seed(0)
    angles = torch.rand((100, 3), generator=generator, dtype=torch.float64) - 0.5
    # The frames: the tile's, turned about z by at most half a radian, then about y, then about x.
    frames = torch.eye(3, dtype=torch.float64).expand(100, 3, 3)
    for (first, second), angle in zip(((0, 1), (2, 0), (1, 2)), angles.T, strict=True):
        turn = torch.eye(3, dtype=torch.float64).repeat(100, 1, 1)
        turn[:, first, first] = turn[:, second, second] = angle.cos()
        turn[:, second, first], turn[:, first, second] = angle.sin(), -angle.sin()
        frames = turn @ frames
    tangent, _, normal = frames.unbind(2)
    # Of any length, and the tangent with a part along the normal.
    a = 1.7 * normal - torch.tensor([0.0, 0.0, 1.0])
    b = 0.6 * (tangent + 0.8 * normal) - torch.tensor([1.0, 0.0, 0.0])
    operation = ops.ToFrame("local", "axes", "omega")
    for axis, expected in zip(frames.unbind(2), torch.eye(3, dtype=torch.float64), strict=True):
        local = cast(Any, PYTORCH[operation])(operation, None, torch.cat([a, b], 1), axis)
        torch.testing.assert_close(local, expected.expand(100, 3), rtol=0, atol=1e-12)
