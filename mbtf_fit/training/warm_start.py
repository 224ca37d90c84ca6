"""Training that starts from another material's textures and offset.

A model of neighborhoods takes a hundred times as long per query as ``neumip``; what both have in common,
textures and offset, is learned sooner by the latter.
"""

from __future__ import annotations

from pathlib import Path

from mbtf_core.errors import InputError
from mbtf_fit.material.format import read_description
from mbtf_fit.material.material import Material
from mbtf_fit.models import NeuralMaterial

# What is taken over, by the first part of a tensor's name; the decoder stays the model's own.
_TAKEN = ("pyramid", "offset_texture", "offset_network")


def take_over(model: NeuralMaterial, start: str | Path) -> None:
    """Give a model the textures and the offset of the material in a folder; its decoder stays as it is.

    Raises
    ------
    InputError : no material there, or its levels, channels, width or kind of offset are others
    """
    given, mine = Material.load(start).model.weights(), model.weights()
    names = [name for name in mine if name.partition(".")[0] in _TAKEN]
    for name in names:
        if name not in given or given[name].shape != mine[name].shape:
            raise InputError(
                f"its '{name}' is not what the fit needs to start from",
                where=start,
                hint="fit it with the same levels, network.channels, network.width, network.layers and "
                "network.offset",
            )
    model.load_weights({**mine, **{name: given[name] for name in names}})


def digest_of(start: str | Path) -> str:
    """What identifies the material in a folder: the digest of its weights.

    Raises
    ------
    InputError : no material there
    """
    description, _ = read_description(Path(start))
    return str(description["weights"]["sha256"])
