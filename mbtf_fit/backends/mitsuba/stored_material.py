"""A material folder as NumPy arrays, for renderers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import InputError
from mbtf_fit.material.format import (
    AGAIN,
    DEFAULT_MIN_COS,
    DESCRIPTION_NAME,
    WEIGHTS_NAME,
    check_conformance,
    lattice_of,
    read_description,
    read_weights,
)
from mbtf_fit.material.transmittance import Transmittance, read_transmittance
from mbtf_fit.ops import Operation, read_operations
from mbtf_fit.ops.operation import SAMPLER
from mbtf_fit.ops.sampler import read_sampler

F32 = NDArray[np.float32]


@dataclass(frozen=True)
class StoredMaterial:
    """Operations and tensors of a fitted material.

    Attributes
    ----------
    folder : the material's folder
    lattice : texel grids of the tile
    min_cos : smallest cosine of the directions in the data
    operations : the list that computes the value in 1/sr
    sampler : the list for importance sampling, empty without
    tensors : what the operations read, by name
    transmittance : None for an opaque material
    conformance : queries ``u``, ``sigma``, ``omega_i``, ``omega_o`` and their values ``rgb`` (n, 3)
    """

    folder: Path
    lattice: Lattice
    min_cos: float
    operations: Sequence[Operation]
    sampler: Sequence[Operation]
    tensors: Mapping[str, NDArray[Any]]
    transmittance: Transmittance | None
    conformance: dict[str, F32]

    def take(self, name: str, shape: Sequence[int | None]) -> F32:
        """A tensor of a shape, in which None stands for any size.

        Raises
        ------
        InputError : it is missing or of another shape
        """
        array, path = self.tensors.get(name), self.folder / WEIGHTS_NAME
        if array is None:
            raise InputError(f"lacks the tensor '{name}'", where=path)
        if len(shape) != array.ndim or any(
            s not in (None, t) for s, t in zip(shape, array.shape, strict=True)
        ):
            raise InputError(f"its tensor '{name}' has the shape {array.shape}", where=path)
        return np.array(array, np.float32, order="C")


def read_material(folder: str | Path) -> StoredMaterial:
    """Read a material folder, without PyTorch.

    Parameters
    ----------
    folder : str or Path
        Folder made by ``mbtf-fit``.

    Returns
    -------
    StoredMaterial

    Raises
    ------
    InputError
        The folder is missing, corrupt, or of another schema.
    """
    folder = Path(folder)
    description, weights = read_description(folder)
    try:
        operations = read_operations(description["operations"])
        tensors = read_weights(weights, description, "np")
        found = description.get(SAMPLER)
        sampler = [] if found is None else read_sampler(found, operations, tensors)
    except ValueError as error:
        raise InputError(str(error), where=folder / DESCRIPTION_NAME, hint=AGAIN) from None
    return StoredMaterial(
        folder,
        lattice_of(description),
        description["data"].get("min_cos", DEFAULT_MIN_COS),
        operations,
        sampler,
        tensors,
        read_transmittance(folder, description),
        check_conformance(tensors, description, weights),
    )
