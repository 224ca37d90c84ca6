"""The fitter's options by quality; see :mod:`mbtf_gen.quality`."""

from __future__ import annotations

from typing import Any

from mbtf_gen.quality import Quality

# What leaves the least error for the time at every size of budget (docs/cost.md): more features and channels,
# directions with their z, for 1.3 times the evaluation, and textures kept smooth where data say little.
BEST: dict[str, Any] = {
    "network.width": 40,
    "network.channels": 12,
    "network.encoding.lifted": True,
    "training.decay": 1.0,
    "training.blur.floor": 0.8,
}

FITTER: dict[Quality, dict[str, Any]] = {
    "draft": {**BEST, "training.time": "20s", "training.steps": None},
    "standard": {**BEST, "training.time": "3min", "training.steps": None},
    "high": {**BEST, "training.time": "20min", "training.steps": None},
    # Kuznetsov et al. 2021: 30 000 steps of 2^20 queries.
    "paper": {**BEST, "training.steps": 30_000, "training.batch": 1 << 20},
}
