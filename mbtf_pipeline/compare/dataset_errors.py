"""Errors of fits on data, and which of two fits is the better one query by query."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.stats import by_group, level_groups, mse_difference
from mbtf_gen.dataset.reader import Dataset

if TYPE_CHECKING:
    from mbtf_fit import Material
    from mbtf_fit.data.queries import ShardQueries


def errors_on_data(materials: Mapping[str, Material], data: Dataset) -> dict[str, Any]:
    """Errors of every fit on the test split of one data set, and on what its own training held out.

    The first fit's name leads; the others also have ``mse_less_first``, their MSE less the first one's on the
    same test queries, overall and by level.

    Raises
    ------
    InputError : a test shard is missing or damaged
    """
    from mbtf_fit.data.loader import load_split
    from mbtf_fit.evaluation import split_errors

    test = load_split(data, "test")
    halves = test.value_a, test.value_b
    labels = level_groups(test.sigma, data.lattice.finest)
    first: Any = None
    out: dict[str, Any] = {}
    for name, material in materials.items():
        value = material.predict(test)
        found = split_errors(partial(_known, value), test, data.lattice)
        own = material.description["training"]["errors"]
        splits = {split: errors for split, errors in own.items() if split != "test"}
        record = {
            "splits": {"test": None if found is None else found.as_dict(), **splits},
            **_size(material),
        }
        if first is None:
            first = value
        else:
            levels = by_group(mse_difference, labels, value, first, *halves)
            record["mse_less_first"] = {
                **mse_difference(value, first, *halves).as_dict(),
                "levels": {str(level): e.as_dict() for level, e in levels.items()},
            }
        out[name] = record
    return out


def _known(value: NDArray[np.float32], queries: ShardQueries) -> NDArray[np.float32]:
    """A prediction that has been made."""
    return value


def _size(material: Material) -> dict[str, Any]:
    """Numbers of a material: of its networks, one by one, and of its textures."""
    weights = material.description["weights"]
    networks: dict[str, int] = {}
    textures = {id(texture.texels) for texture in material.model.textures()}
    for name, parameter in material.model.named_parameters():
        if id(parameter) not in textures:
            part = name.split(".")[0]
            networks[part] = networks.get(part, 0) + parameter.numel()
    return {
        "network_weights": weights["network_weights"],
        "networks": networks,
        "texels": weights["texels"],
        "training_seconds": material.description["training"]["seconds"],
        "model": material.config.model,
    }
