"""Rays and horizons of a periodic height field, outside of a renderer.

The surface is that of :mod:`mbtf_gen.tile.tracers.heightfield_tracer`: vertices on texel centers, two
triangles per cell, which meet where ``x + y = 1`` (x and y from 0 to 1 across the cell, along u and v). A
line through the reference plane meets it at a single height, the only number that is stored: with ω towards
the viewer, the intersection lies at ``x + z/ω_z · ω_xy``, z ≤ 0.

Where the compiled kernel is missing, :func:`trace_reference` follows the rays cell by cell in PyTorch.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbtf_core.height_planes import node_table
from mbtf_fit.native.library import Heightfield, kernel
from mbtf_fit.ops.constants import MAX_CROSSINGS

# Rays, and vertices, per task of a thread.
_RAYS, _VERTICES = 1 << 14, 1 << 12
# Smallest magnitude of a direction's component, which avoids 0/0 for rays parallel to an axis.
_TINY = 1e-18
# Tile widths that a horizon is searched within.
HORIZON_DISTANCE = 4.0

F32 = NDArray[np.float32]


class DeviceCopies:
    """A tensor that does not change, and its copies on other devices, each of which is made once."""

    def __init__(self, tensor: Tensor) -> None:
        self._copies = {tensor.device: tensor}

    def on(self, device: torch.device) -> Tensor:
        """The tensor on a device."""
        if device not in self._copies:
            self._copies[device] = next(iter(self._copies.values())).to(device)
        return self._copies[device]


class HeightfieldTracer:
    """Intersections of lines with a periodic height field.

    Parameters
    ----------
    heights : (H, W) float array, z of the vertices in tile widths, maximum 0; row 0 is the side ``v → 1``
    aspect : height of the tile over its width

    Attributes
    ----------
    description : what the kernel's functions take
    """

    def __init__(self, heights: F32, aspect: float) -> None:
        # Row index along +y.
        self._z = np.ascontiguousarray(heights[::-1], np.float32)
        self._nodes = np.ascontiguousarray(node_table(self._z.astype(np.float64)))
        rows, columns = self._z.shape
        cells = torch.from_numpy(self._nodes[: self._z.size])
        self._cells = DeviceCopies(cells.view(rows, columns, 4))
        self.aspect = aspect
        columns_log2, rows_log2 = (columns - 1).bit_length(), (rows - 1).bit_length()
        self.description = Heightfield(
            self._nodes.ctypes.data,
            self._z.ctypes.data,
            columns,
            rows,
            columns_log2,
            columns_log2 + rows_log2,
            min(columns_log2, rows_log2),
            aspect,
        )

    def trace(self, u: Tensor, omega: Tensor) -> Tensor:
        """Heights (n,) in tile widths at which lines first meet the surface.

        Parameters
        ----------
        u : (n, 2) tensor, points of the reference plane, uv
        omega : (n, 3) tensor, unit vectors towards the viewer, z > 0
        """
        found = kernel()
        if found is None or u.device.type != "cpu":
            return trace_reference(self._cells.on(u.device), self.aspect, u, omega)
        u, omega = (a.detach().float().contiguous() for a in (u, omega))
        out = torch.empty(len(u))

        def part(start: int) -> None:
            found.library.mbtf_trace(
                ctypes.byref(self.description),
                min(_RAYS, len(u) - start),
                u.data_ptr() + 8 * start,
                omega.data_ptr() + 12 * start,
                MAX_CROSSINGS,
                out.data_ptr() + 4 * start,
            )

        _each(part, range(0, len(u), _RAYS))
        return out

    def horizons(self, azimuths: int) -> Tensor:
        """Elevation angles (H, W, azimuths) of the horizon at the vertices, in radians: of the highest
        direction that meets the surface, for azimuths ``2π k / azimuths`` from +u towards +v. Row 0 is the
        side ``v → 1``."""
        found = kernel()
        z = self._z
        if found is None:
            return torch.from_numpy(horizons_reference(z, self.aspect, azimuths)[::-1].copy())
        out = np.empty((*z.shape, azimuths), np.float32)

        def part(start: int) -> None:
            found.library.mbtf_horizons(
                ctypes.byref(self.description),
                azimuths,
                HORIZON_DISTANCE,
                start,
                min(start + _VERTICES, z.size),
                out.ctypes.data,
            )

        _each(part, range(0, z.size, _VERTICES))
        return torch.from_numpy(out[::-1].copy())


def _each(task: Callable[[int], None], starts: Iterable[int]) -> None:
    with ThreadPoolExecutor(max(1, torch.get_num_threads())) as pool:
        list(pool.map(task, starts))


def trace_reference(cells: Tensor, aspect: float, u: Tensor, omega: Tensor) -> Tensor:
    """:meth:`HeightfieldTracer.trace` in PyTorch, cell by cell.

    Parameters
    ----------
    cells : (rows, columns, 4) tensor, surface of each cell, see :mod:`mbtf_core.height_planes`; row index
        along +y
    """
    rows, columns = cells.shape[:2]
    table = cells.reshape(-1, 4)
    scale = u.new_tensor([columns, rows / aspect, 1.0])
    d = -omega * scale
    both = d[:, 0] + d[:, 1]
    inverse = 1.0 / torch.where(d >= 0, d.clamp_min(_TINY), d.clamp_max(-_TINY))
    over_both = -1.0 / torch.where(both >= 0, both.clamp_min(_TINY), both.clamp_max(-_TINY))
    position = u * u.new_tensor([columns, rows]) - 0.5
    size = u.new_tensor([columns, rows])
    position = position - (position / size).floor() * size
    cell = torch.minimum(position.long(), size.long() - 1).clamp_min(0)
    p, z = position - cell, torch.zeros_like(u[:, 0])
    crossings = torch.zeros_like(cell[:, 0])
    active = torch.arange(len(u), device=u.device)
    while len(active):
        node = table[cell[active, 1] * columns + cell[active, 0]]
        step, x = d[active], p[active]
        to = ((step[:, :2] >= 0).to(x.dtype) - x) * inverse[active, :2]
        end = to.amin(1).clamp_min(0)
        here = z[active] - (node[:, 0] + x[:, 0] * node[:, 1] + x[:, 1] * node[:, 2])
        slope = step[:, 2] - step[:, 0] * node[:, 1] - step[:, 1] * node[:, 2]
        across = x[:, 0] + x[:, 1] - 1.0
        fold = (end * both[active] + across).clamp_min(0) * node[:, 3]
        diagonal = across * over_both[active]
        passes = (diagonal > 0) & (diagonal < end)
        free = (here + end * slope - fold > 0) & ~(passes & (here + diagonal * slope <= 0))

        second = ((across > 0) | ((across == 0) & (both[active] > 0))) ^ (
            passes & (here + diagonal * slope > 0)
        )
        bend = torch.where(second, node[:, 3], 0.0)
        t = (here - across * bend) / (both[active] * bend - slope)
        t = torch.where(free, end, torch.minimum(t.clamp_min(0), end))
        z[active] += t * step[:, 2]

        x = x + end[:, None] * step[:, :2]
        axis = (to[:, 1] < to[:, 0]).long()[:, None]
        forward = (step[:, :2] >= 0).gather(1, axis)
        x.scatter_(1, axis, torch.where(forward, 0.0, 1.0).to(x.dtype))
        moved = cell[active].scatter_add(1, axis, torch.where(forward, 1, -1))
        wrapped = moved.remainder(size.long())
        crossings[active] += (wrapped != moved).any(1)
        p[active], cell[active] = x.clamp(0, 1), wrapped
        active = active[free & (crossings[active] <= MAX_CROSSINGS)]
    return z


def horizons_reference(z: F32, aspect: float, azimuths: int) -> F32:
    """:meth:`HeightfieldTracer.horizons` in NumPy, row index along +y.

    Heights are read where the direction crosses the grid's lines, those that it crosses more often.
    """
    rows, columns = z.shape
    out = np.empty((rows, columns, azimuths), np.float32)
    for k in range(azimuths):
        angle = 2.0 * math.pi * k / azimuths
        per_length = np.array([math.cos(angle) * columns, math.sin(angle) * rows / aspect])
        step = 1.0 / np.abs(per_length).max()
        tangent = np.zeros_like(z)
        distance = 0.0
        for _ in range(int(HORIZON_DISTANCE / step)):
            distance += step
            # No vertex is higher than 0.
            if (-z <= distance * tangent).all():
                break
            at = per_length * distance
            i, j = (math.floor(x + 1e-6) for x in at)
            fx, fy = (max(0.0, x - n) for x, n in zip(at, (i, j), strict=True))
            near = np.roll(z, (-j, -i), (0, 1))
            if fx > 1e-6:
                height = near + fx * (np.roll(near, -1, 1) - near)
            else:
                height = near + fy * (np.roll(near, -1, 0) - near)
            tangent = np.maximum(tangent, (height - z) / distance)
        out[..., k] = np.arctan(tangent)
    return out
