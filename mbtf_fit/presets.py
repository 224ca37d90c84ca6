"""Options of the fitter by quality preset; see :mod:`mbtf_gen.config.presets`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mbtf_core.config_file import merge, read_yaml
from mbtf_core.units import parse_duration
from mbtf_gen.config.presets import Quality

# Network sizes by training time in seconds. With directions of three coordinates and smooth textures they
# reached the lowest error for their time in cost studies of four materials.
_SIZES = (
    (0.0, {"network.width": 40, "network.channels": 12}),
    (300.0, {"network.width": 64, "network.channels": 16}),
)
_DIRECTIONS: dict[str, Any] = {"network.encoding.direction_xyz": True}
_SMOOTHING: dict[str, Any] = {"training.texture_weight_decay": 1.0, "training.blur.min_sigma": 0.8}
# Models that these options were measured for.
_MODELS = ("neumip", "neumip-baseline")

# Training times.
FITTER: dict[Quality, dict[str, Any]] = {
    "draft": {"training.time": "20s", "training.steps": None},
    "standard": {"training.time": "3min", "training.steps": None},
    "high": {"training.time": "10min", "training.steps": None},
    # Kuznetsov et al. 2021: 30 000 steps of 2^20 queries.
    "paper": {"training.steps": 30_000, "training.batch": 1 << 20},
}


def _network(seconds: float) -> dict[str, Any]:
    size = [size for least, size in _SIZES if seconds >= least][-1]
    return size | _DIRECTIONS


def best_options(seconds: float) -> dict[str, Any]:
    """Network and smoothing of `neumip` and its baseline, dotted names, for a training time in seconds on two
    processor cores."""
    return _network(seconds) | _SMOOTHING


def best_at(quality: Quality) -> dict[str, Any]:
    """:func:`best_options` for the training time of a preset."""
    return best_options(_seconds(quality))


def _seconds(quality: Quality) -> float:
    """Training time of a preset; infinite where it counts steps."""
    training = FITTER[quality].get("training.time")
    return math.inf if training is None else parse_duration(training)


def fitter_options(quality: Quality, fits: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Options of fits at a preset, dotted names: the training time, and for `neumip` and its baseline those
    options of :func:`best_at` that the user does not set.

    If the user sets any option of one fit's network, all fits keep their own networks: such recipes compare
    networks.

    Parameters
    ----------
    fits : by name, the options that files and command line set for each fit, nested, with its model
    """
    free = not any("network" in given or given.get("start") for given in fits.values())
    out = {}
    for name, given in fits.items():
        training = given.get("training")
        training = training if isinstance(training, Mapping) else {}
        options: dict[str, Any] = {}
        if given.get("model") in _MODELS:
            options |= _network(_seconds(quality)) if free else {}
            options |= {k: v for k, v in _SMOOTHING.items() if k.split(".")[1] not in training}
        out[name] = options | FITTER[quality]
    return out


def overrides_of(file: Path | None, assignments: Sequence[str]) -> dict[str, Any]:
    """Options that a configuration file and ``a.b=c`` set, nested; values of the latter as text.

    Raises
    ------
    InputError : the file cannot be read
    """
    found = read_yaml(file) if file is not None else {}
    given = dict(found) if isinstance(found, Mapping) else {}
    for text in assignments:
        name, _, value = text.partition("=")
        merge(given, name.strip().split("."), value.strip())
    return given
