"""Initialization of a fit from another material's textures and offset.

A step of the hierarchical model takes a hundred times as long per query as a step of ``neumip``. Both share
textures and offset, which ``neumip`` learns sooner.
"""

from __future__ import annotations

from pathlib import Path

from mbtf_core.errors import InputError
from mbtf_fit.material.format import read_description
from mbtf_fit.material.material import Material
from mbtf_fit.models.interface import NeuralMaterial

# Tensors to copy, by the first part of their names; the decoder keeps its own initialization.
_SHARED = ("pyramid", "offset_texture", "offset_network")


def initialize_from(model: NeuralMaterial, folder: str | Path) -> None:
    """Copy textures and offset of a material into a model.

    Raises
    ------
    InputError : no material there, or its levels, channels, width or kind of offset differ
    """
    given, mine = Material.load(folder).model.weights(), model.weights()
    names = [name for name in mine if name.partition(".")[0] in _SHARED]
    for name in names:
        if name not in given or given[name].shape != mine[name].shape:
            raise InputError(
                f"its '{name}' does not have the shape that the fit needs",
                where=folder,
                hint="fit it with the same levels, network.channels, network.width, network.layers and "
                "network.offset",
            )
    model.load_weights({**mine, **{name: given[name] for name in names}})


def weights_digest(folder: str | Path) -> str:
    """SHA-256 of the weights of a material.

    Raises
    ------
    InputError : no material there
    """
    description, _ = read_description(Path(folder))
    return str(description["weights"]["sha256"])
