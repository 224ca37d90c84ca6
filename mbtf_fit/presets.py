"""The fitter's options of each quality preset; see :mod:`mbtf_gen.config.generator`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from mbtf_core.app.options import Quality
from mbtf_core.units import parse_duration
from mbtf_fit.config import DEFAULT_MODEL, ModelName

# Options of least error per time in the cost studies: larger networks and textures than the paper's, growing
# with the training time (seconds).
_Sizes = tuple[tuple[float, dict[str, Any]], ...]
_NEUMIP: _Sizes = (
    (0.0, {"network.width": 40, "network.channels": 12}),
    (300.0, {"network.width": 64, "network.channels": 16}),
)
# For the models of the paper: directions with z, and smooth textures where data are few.
_SMOOTH: dict[str, Any] = {
    "network.encoding.direction_xyz": True,
    "training.texture_weight_decay": 1.0,
    "training.blur.min_sigma": 0.8,
}
# Oversampled textures of `relief` gain nothing from more channels in a few minutes, and steps take longer.
# Two view rays per footprint take 1.3 times as long to evaluate, four twice.
_RELIEF: _Sizes = (
    (0.0, {"network.width": 40, "network.channels": 8, "network.relief.places": 1}),
    (100.0, {"network.width": 40, "network.channels": 8, "network.relief.places": 2}),
    (300.0, {"network.width": 64, "network.channels": 16, "network.relief.places": 4}),
)
# Models that have such options.
_MODELS: tuple[ModelName, ...] = ("relief", "neumip+", "neumip", "neumip-baseline")

# Budget of each preset.
FITTER: dict[Quality, dict[str, Any]] = {
    "draft": {"training.time": "12s", "training.steps": None},
    "standard": {"training.time": "3min", "training.steps": None},
    "high": {"training.time": "10min", "training.steps": None},
    # Kuznetsov et al. 2021: 30 000 steps of 2^20 queries.
    "paper": {"training.steps": 30_000, "training.batch": 1 << 20},
}


def best_options(seconds: float, model: ModelName = DEFAULT_MODEL) -> dict[str, Any]:
    """Network and smoothing options of a model, dotted names, for a training time (seconds) on two processor
    cores; none for a model other than `relief`, `neumip` and its baseline."""
    if model not in _MODELS:
        return {}
    sizes, rest = (_RELIEF, {}) if model == "relief" else (_NEUMIP, _SMOOTH)
    return [size for least, size in sizes if seconds >= least][-1] | rest


def best_at(quality: Quality, model: ModelName = DEFAULT_MODEL) -> dict[str, Any]:
    """:func:`best_options` for the training time of a quality preset: infinite for a number of steps."""
    training = FITTER[quality].get("training.time")
    return best_options(math.inf if training is None else parse_duration(training), model)


def fitter_options(
    quality: Quality, fits: Mapping[str, Mapping[str, Any]], seconds: float | None = None
) -> dict[str, dict[str, Any]]:
    """Options of fits at a quality preset, dotted names: their budget, and :func:`best_at`. Explicit values
    override the preset.

    If any fit sets a network option, all keep the networks of their papers, so that they can be compared.

    Parameters
    ----------
    fits : name → explicit options of files and command line, nested, with the model
    seconds : training time that decides the network; the preset's by default
    """
    free = not any(
        "network" in given or given.get("init_from") or given.get("decoder") for given in fits.values()
    )
    out = {}
    for name, given in fits.items():
        training = given.get("training")
        training = training if isinstance(training, Mapping) else {}
        model = given.get("model", DEFAULT_MODEL)
        best = best_at(quality, model) if seconds is None else best_options(seconds, model)
        kept = {
            key: value
            for key, value in best.items()
            if (free if key.startswith("network.") else key.split(".")[1] not in training)
        }
        out[name] = kept | FITTER[quality]
    return out
