"""The fitter's options by quality; see :mod:`mbtf_gen.config.presets`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mbtf_core.config_file import merge, read_yaml
from mbtf_core.units import parse_duration
from mbtf_gen.config.presets import Quality

# What leaves the least error for the time (docs/cost.md): more features and channels than the paper's, the
# more the longer training is (seconds), directions with their z, and textures kept smooth where data say
# little.
_SIZES = (
    (0.0, {"network.width": 40, "network.channels": 12}),
    (300.0, {"network.width": 64, "network.channels": 16}),
)
_LIFTED: dict[str, Any] = {"network.encoding.direction_xyz": True}
_SMOOTH: dict[str, Any] = {"training.texture_weight_decay": 1.0, "training.blur.min_sigma": 0.8}
# Models that it was measured for.
_MODELS = ("neumip", "neumip-baseline")

# How long fits are trained.
FITTER: dict[Quality, dict[str, Any]] = {
    "draft": {"training.time": "20s", "training.steps": None},
    "standard": {"training.time": "3min", "training.steps": None},
    "high": {"training.time": "10min", "training.steps": None},
    # Kuznetsov et al. 2021: 30 000 steps of 2^20 queries.
    "paper": {"training.steps": 30_000, "training.batch": 1 << 20},
}


def _network(seconds: float) -> dict[str, Any]:
    size = [size for least, size in _SIZES if seconds >= least][-1]
    return size | _LIFTED


def best_options(seconds: float) -> dict[str, Any]:
    """Network and smoothing of `neumip` and its baseline, dotted names, for so many seconds of training
    on two processor cores."""
    return _network(seconds) | _SMOOTH


def best_at(quality: Quality) -> dict[str, Any]:
    """:func:`best_options` of the time that a quality trains for."""
    return best_options(_seconds(quality))


def _seconds(quality: Quality) -> float:
    """Of training; infinitely many where steps are counted."""
    training = FITTER[quality].get("training.time")
    return math.inf if training is None else parse_duration(training)


def fitter_options(quality: Quality, fits: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Options of fits at a quality, dotted names: how long they train, and for `neumip` and its baseline what
    of :func:`best_at` nobody has said anything about.

    What is said of one fit's network keeps all of them as their papers have them: such fits are compared for
    it.

    Parameters
    ----------
    fits : by name, what files and command line say of each, nested, with its model
    """
    free = not any("network" in said or said.get("start") for said in fits.values())
    out = {}
    for name, said in fits.items():
        training = said.get("training")
        training = training if isinstance(training, Mapping) else {}
        options: dict[str, Any] = {}
        if said.get("model") in _MODELS:
            options |= _network(_seconds(quality)) if free else {}
            options |= {k: v for k, v in _SMOOTH.items() if k.split(".")[1] not in training}
        out[name] = options | FITTER[quality]
    return out


def overrides_of(file: Path | None, assignments: Sequence[str]) -> dict[str, Any]:
    """What a configuration file and ``a.b=c`` say, nested; values of the latter as text.

    Raises
    ------
    InputError : the file cannot be read
    """
    found = read_yaml(file) if file is not None else {}
    said = dict(found) if isinstance(found, Mapping) else {}
    for text in assignments:
        name, _, value = text.partition("=")
        merge(said, name.strip().split("."), value.strip())
    return said
