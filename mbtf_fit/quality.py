"""The fitter's options by quality; see :mod:`mbtf_gen.quality`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mbtf_gen.quality import Quality
from mbtf_gen.settings import merge, read_yaml

# What leaves the least error for the time at every size of budget (docs/cost.md): more features and channels,
# directions with their z, and textures kept smooth where data say little.
_NETWORK: dict[str, Any] = {
    "network.width": 40,
    "network.channels": 12,
    "network.encoding.lifted": True,
}
_SMOOTH: dict[str, Any] = {"training.decay": 1.0, "training.blur.floor": 0.8}
BEST: dict[str, Any] = {**_NETWORK, **_SMOOTH}
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


def fitter_options(quality: Quality, fits: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Options of fits at a quality, dotted names: how long they train, and for `neumip` and its baseline what
    :data:`BEST` holds and nobody has said anything about.

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
            options |= _NETWORK if free else {}
            options |= {k: v for k, v in _SMOOTH.items() if k.split(".")[1] not in training}
        out[name] = options | FITTER[quality]
    return out


def said_of(file: Path | None, assignments: Sequence[str]) -> dict[str, Any]:
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
