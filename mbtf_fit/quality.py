"""The fitter's options by quality; see :mod:`mbtf_gen.quality`."""

from __future__ import annotations

from typing import Any

from mbtf_gen.quality import Quality

FITTER: dict[Quality, dict[str, Any]] = {
    "draft": {"training.time": "20s", "training.steps": None},
    "standard": {"training.time": "3min", "training.steps": None},
    # More features, and directions with their z: what lowers the error most for 1.3 times the evaluation.
    "high": {
        "training.time": "20min",
        "training.steps": None,
        "network.width": 40,
        "network.channels": 12,
        "network.encoding.lifted": True,
    },
    # Kuznetsov et al. 2021: 30 000 steps of 2^20 queries.
    "paper": {"training.steps": 30_000, "training.batch": 1 << 20},
}
