"""Advice after a fit or its evaluation."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mbtf_core.data.folder import DataFolder
    from mbtf_fit.material.material import Material
    from mbtf_fit.training.next_step import NextStep


def suggest(material: Material, history: list[dict[str, Any]], errors: dict[str, Any]) -> NextStep | None:
    """What reduces the error of a fit most, from the records of its validations and its errors by split. None
    where it is unfinished, has reached the error that it was asked for, or shares a network."""
    from mbtf_fit.training.endings import reached
    from mbtf_fit.training.next_step import next_step
    from mbtf_fit.training.validation import marginal_cost_of

    config, training = material.config, material.description["training"]
    cost = marginal_cost_of(history, errors, training)
    if cost is None or not errors or config.training.shared_decoder or reached(config, history):
        return None
    return next_step(cost, errors)


def advise(
    material: Material,
    shards: DataFolder,
    history: list[dict[str, Any]],
    errors: dict[str, Any],
) -> str | None:
    """One line on what reduces the error of a fit most, by its errors on a data set; None where
    :func:`suggest` has none."""
    from mbtf_core.data.dataset import Dataset
    from mbtf_fit.training.fit_folder import training_digest

    step = suggest(material, history, errors)
    if step is None:
        return None
    if material.description["training"]["shards_sha256"] != training_digest(Dataset.open(shards)):
        return "the fit had other training data; evaluate it on them for advice"
    return step.reason
