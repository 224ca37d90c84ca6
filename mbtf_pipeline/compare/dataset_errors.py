"""Errors of fits on a data set, and paired differences between fits on the same queries."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from mbtf_core.data.dataset import Dataset
from mbtf_core.stats import by_group, level_groups, mse_difference

if TYPE_CHECKING:
    from mbtf_fit import Material


def dataset_errors(materials: Mapping[str, Material], data: Dataset) -> dict[str, Any]:
    """Errors of every fit on the test split of one data set, and on the splits held out in its own training.

    All fits but the first also have ``mse_minus_first``: their MSE minus that of the first fit on the same
    test queries, overall and by level. Of measured data, which have one value per query, errors include the
    noise and say so (``includes_noise``); differences do not. Returns plain data by name of the fit.

    Raises
    ------
    InputError : a test shard is missing or corrupt
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
        found = split_errors(partial(_stored, value), test, data)
        own = material.description["training"]["errors"]
        splits = {split: errors for split, errors in own.items() if split != "test"}
        record = {
            "splits": {"test": found, **splits},
            **_parameter_counts(material),
        }
        if first is None:
            first = value
        else:
            levels = by_group(mse_difference, labels, value, first, *halves)
            record["mse_minus_first"] = {
                **mse_difference(value, first, *halves).as_dict(),
                "levels": {str(level): e.as_dict() for level, e in levels.items()},
            }
        out[name] = record
    return out


def _stored(value: Any, queries: Any) -> Any:
    """An evaluated prediction, as a function of the queries."""
    return value


def _parameter_counts(material: Material) -> dict[str, Any]:
    """Parameter counts of a material: per network, and of its textures."""
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
