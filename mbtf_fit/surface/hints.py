"""Hints of many queries, by the compiled kernel or in PyTorch."""

from __future__ import annotations

import ctypes
from concurrent.futures import ThreadPoolExecutor

import torch
from torch import Tensor

from mbtf_core.data.schema import CLEARCOAT_F0
from mbtf_fit.native.library import (
    MAX_LEVELS,
    MAX_PLACES,
    QueryPointers,
    SurfaceStruct,
    TexturesStruct,
    kernel,
)
from mbtf_fit.ops.constants import ALBEDO_SPREAD, FIBER_HINTS, HINTS, VOIGT_SCALE, VOIGT_WIDENING
from mbtf_fit.ops.fibers import FiberFrame
from mbtf_fit.ops.lookup import Trace
from mbtf_fit.ops.shade import Shade, grazing_reflectance
from mbtf_fit.surface.known import KnownSurface
from mbtf_fit.surface.lookup import Packing

# Queries per task of a thread; in PyTorch, queries at once, which bounds the memory of the lookups.
_TASK, _CHUNK = 1 << 14, 1 << 17


def describe_textures(table: Tensor, packing: Packing, into: TexturesStruct) -> None:
    """Fill the kernel's description of textures; it has the address of the table, which must outlive it."""
    into.levels, into.channels = len(packing.shapes), table.shape[1]
    into.rows[: len(packing.shapes)] = [rows for rows, _ in packing.shapes]
    into.columns[: len(packing.shapes)] = [columns for _, columns in packing.shapes]
    into.starts[: len(packing.shapes) + 1] = packing.starts
    into.table = table.data_ptr()


def compute_hints(
    surface: KnownSurface,
    trace: Trace,
    shade: Shade,
    fibers: FiberFrame | None,
    u: Tensor,
    sigma: Tensor,
    omega_i: Tensor,
    omega_o: Tensor,
) -> Tensor:
    """Results of the operations for queries.

    Parameters
    ----------
    trace, shade, fibers : the operations
    u, sigma, omega_i, omega_o : (n, 2), (n,), (n, 3), (n, 3) tensors, position in uv, footprint in tile
        widths, light and view

    Returns
    -------
    (n, 7) tensor, or (n, 13) with fibers
        Height, irradiance, normal (x, y), core (RGB), directions about the fibers.
    """
    native = kernel()
    finest, places = surface.lattice.finest, len(trace.places)
    if native is None or u.device.type != "cpu" or finest + 2 > MAX_LEVELS or places > MAX_PLACES:
        level = (-torch.log2(2.0 * sigma)).clamp(0.0, float(finest))
        parts = []
        for start in range(0, len(u), _CHUNK):
            c = slice(start, start + _CHUNK)
            height, hits, depths = surface.intersections(trace, u[c], level[c], omega_o[c])
            found = [height, surface.shading(shade, hits, level[c], omega_i[c], omega_o[c], depths)]
            if fibers is not None:
                found.append(surface.about_fibers(fibers, hits, level[c], omega_i[c], omega_o[c]))
            parts.append(torch.cat(found, 1))
        return torch.cat(parts)
    arrays = [a.detach().float().contiguous() for a in (u, sigma, omega_i, omega_o)]
    columns = HINTS if fibers is None else HINTS + FIBER_HINTS
    out = torch.empty(len(u), columns)
    description = SurfaceStruct(heightfield=surface.tracer.description)
    describe_textures(*surface.map_table, description.maps)
    describe_textures(*surface.horizon_table, description.horizons)
    if fibers is not None:
        describe_textures(*surface.fiber_table, description.fibers)
        description.fiber_finer, description.least_tangents = fibers.finer, fibers.least_tangents
        description.least_cosine, description.least_spread = fibers.least_cosine, fibers.least_variance
    description.places, description.finer = places, shade.finer
    description.offsets[: 2 * places] = [x for offset in trace.places for x in offset]
    description.light_width, description.light_blur = surface.light_width, shade.light_blur
    description.dielectric, description.edge = surface.dielectric, grazing_reflectance(surface.dielectric)
    description.light_depth = 0.0 if shade.heights is None else shade.light_depth
    description.coat, description.least_view = CLEARCOAT_F0, shade.least_view
    description.albedo_spread[:], description.alpha2[:] = ALBEDO_SPREAD, shade.alpha2
    description.voigt[:] = VOIGT_WIDENING, VOIGT_SCALE

    def task(start: int) -> None:
        addresses = (a.data_ptr() + 4 * start * a.stride(0) for a in arrays)
        queries = QueryPointers(min(_TASK, len(u) - start), *addresses)
        to = out.data_ptr() + 4 * start * columns
        native.library.mbtf_hints(
            ctypes.byref(description), ctypes.byref(queries), float(finest), trace.crossings, to
        )

    with ThreadPoolExecutor(max(1, torch.get_num_threads())) as pool:
        list(pool.map(task, range(0, len(u), _TASK)))
    return out
