"""Time of one evaluation, split into what depends on the view alone and what depends on the light.

A model evaluates in two stages. Stage 1 (offset and lookup) depends on the view only, stage 2 also on the
light, so several lights share stage 1. Both are timed in PyTorch at random queries. The whole evaluation is
also timed through :meth:`~mbtf_fit.Material.evaluate`.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor

    from mbtf_fit import Material

# Numbers of lights per view.
LIGHTS = (1, 4, 16)
# Queries per batch, and number of timed repetitions after one warm-up run.
_CHUNK = 1 << 15
_TIMINGS = 3
_SEED = 7
# One of so many pixels is evaluated and the time scaled up: it is proportional to the number of queries.
_SUBSAMPLING = 8

T = TypeVar("T")


def timed(work: Callable[[], T]) -> tuple[T, float]:
    """What `work` returns, and the median of several timings in seconds after one warm-up run."""
    result = work()
    seconds = []
    for _ in range(_TIMINGS):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return result, statistics.median(seconds)


def _random_queries(count: int, finest: int) -> list[NDArray[np.float32]]:
    """u, σ, ω_i and ω_o of queries over all levels, with directions within 60° of the normal."""
    from mbtf_core.data.lattice import sigma_of_level
    from mbtf_core.directions import from_projected_disk

    rng = np.random.default_rng(_SEED)
    angle = 2 * np.pi * rng.random((2, count))
    radius = np.sqrt(0.75 * rng.random((2, count)))
    light, view = from_projected_disk(np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1))
    arrays = (rng.random((count, 2)), sigma_of_level(finest * rng.random(count)), light, view)
    return [np.asarray(a, np.float32) for a in arrays]


def _seconds(work: Callable[[], Any]) -> float:
    """Time of the work without gradients, including the wait for the GPU."""
    import torch

    def run() -> None:
        work()
        if torch.cuda.is_available():
            torch.cuda.synchronize()

    with torch.no_grad():
        return timed(run)[1]


def measure_timing(material: Material, pixels: int, device: str) -> dict[str, Any]:
    """Milliseconds of one evaluation per pixel on a PyTorch device, in total and by stage; plain data.

    An eighth of the pixels is evaluated, fewer for models that read several positions per query. The times
    are scaled to all pixels; ``queries`` is the number evaluated.
    """
    import torch

    model = material.model
    count = max(1, pixels // (_SUBSAMPLING * model.positions))
    queries = _random_queries(count, model.lattice.finest)
    size = max(1, _CHUNK // model.positions)
    chunks = list(zip(*(torch.from_numpy(a).to(device).split(size) for a in queries), strict=True))
    scale = 1e3 * pixels / count

    def milliseconds(part: Callable[..., Any]) -> float:
        return scale * _seconds(lambda: [part(*chunk) for chunk in chunks])

    # Stage 2 is timed with the features of the first chunk: its time does not depend on their values.
    u, sigma, _, view = chunks[0]
    with torch.no_grad():
        features = model.stage1(u, sigma, view)
    first = milliseconds(lambda u, s, i, o: model.stage1(u, s, o))
    second = milliseconds(lambda u, s, i, o: model.stage2(_first(features, len(u), len(view)), i, o))
    return {
        "device": device,
        "pixels": pixels,
        "queries": count,
        "evaluate_ms": round(scale * _seconds(lambda: material.evaluate(*queries)), 3),
        "stage1_ms": round(first, 3),
        "stage2_ms": round(second, 3),
        "lights_ms": {str(n): round(first + n * second, 3) for n in LIGHTS},
    }


def _first(values: dict[str, Tensor], count: int, of: int) -> dict[str, Tensor]:
    """Values of the first queries."""
    return {name: value[: count * (len(value) // of)] for name, value in values.items()}
