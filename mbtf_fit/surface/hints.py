"""Hints of many queries, by the compiled kernel or in PyTorch."""

from __future__ import annotations

import ctypes
from concurrent.futures import ThreadPoolExecutor

import torch
from torch import Tensor

from mbtf_fit.models.constants import (
    ALPHA2,
    HINTS,
    LEAST_LIGHT,
    LEAST_VIEW,
    LIGHT_BLUR,
    MAX_CROSSINGS,
    PLACES,
)
from mbtf_fit.models.lookup import Packing
from mbtf_fit.native.library import MAX_LEVELS, QueryPointers, Surface, Textures, kernel
from mbtf_fit.surface.known import KnownSurface

# Queries per task of a thread; in PyTorch, queries at once, which bounds the memory of the lookups.
_TASK, _CHUNK = 1 << 14, 1 << 17


def describe_textures(table: Tensor, packing: Packing, into: Textures) -> None:
    """Fill the kernel's description of textures; it has the address of the table, which must outlive it."""
    into.levels, into.channels = len(packing.shapes), table.shape[1]
    into.rows[: len(packing.shapes)] = [rows for rows, _ in packing.shapes]
    into.columns[: len(packing.shapes)] = [columns for _, columns in packing.shapes]
    into.starts[: len(packing.shapes) + 1] = packing.starts
    into.table = table.data_ptr()


def compute_hints(
    surface: KnownSurface, u: Tensor, sigma: Tensor, omega_i: Tensor, omega_o: Tensor, places: int
) -> Tensor:
    """Hints of queries.

    Parameters
    ----------
    surface : KnownSurface
    u, sigma, omega_i, omega_o : (n, 2), (n,), (n, 3), (n, 3) tensors
        Position in uv, footprint in tile widths, light and view.
    places : int
        Places of the footprint that are traced: 1, 2 or 4.

    Returns
    -------
    (n, 7) tensor
        As :meth:`KnownSurface.hints <mbtf_fit.surface.known.KnownSurface.hints>`.
    """
    found = kernel()
    finest = surface.lattice.finest
    if found is None or u.device.type != "cpu" or finest + 2 > MAX_LEVELS:
        level = (-torch.log2(2.0 * sigma)).clamp(0.0, float(finest))
        chunks = [slice(start, start + _CHUNK) for start in range(0, len(u), _CHUNK)]
        parts = [surface.hints(u[c], level[c], omega_i[c], omega_o[c], places) for c in chunks]
        return torch.cat(parts)
    arrays = [a.detach().float().contiguous() for a in (u, sigma, omega_i, omega_o)]
    out = torch.empty(len(u), HINTS)
    description = Surface(heightfield=surface.tracer.description)
    describe_textures(*surface.map_table, description.maps)
    describe_textures(*surface.horizon_table, description.horizons)
    offsets, description.finer = PLACES[places]
    description.places = places
    description.offsets[: 2 * places] = [x for offset in offsets for x in offset]
    description.light_width, description.light_blur = surface.light_width, LIGHT_BLUR
    description.dielectric = surface.dielectric
    description.least_light, description.least_view = LEAST_LIGHT, LEAST_VIEW
    description.alpha2[:] = ALPHA2

    def task(start: int) -> None:
        addresses = (a.data_ptr() + 4 * start * a.stride(0) for a in arrays)
        queries = QueryPointers(min(_TASK, len(u) - start), *addresses)
        to = out.data_ptr() + 4 * start * HINTS
        found.library.mbtf_hints(
            ctypes.byref(description), ctypes.byref(queries), float(finest), MAX_CROSSINGS, to
        )

    with ThreadPoolExecutor(max(1, torch.get_num_threads())) as pool:
        list(pool.map(task, range(0, len(u), _TASK)))
    return out
