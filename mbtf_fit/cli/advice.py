"""The next command after a fit or its evaluation."""

from __future__ import annotations

from pathlib import Path
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
    folder: Path,
    shards: Path | DataFolder,
    history: list[dict[str, Any]],
    errors: dict[str, Any],
) -> tuple[str | None, list[str]]:
    """What reduces the error of a fit in a folder most: the command, and the lines that say why; neither
    where :func:`suggest` has none. `errors` by split are those on the data set `shards`; where these are
    other test queries of the training data, the errors of its other splits are those of the fit."""
    from mbtf_core.data.dataset import Dataset
    from mbtf_fit.training.fit_folder import configuration_digest, training_digest

    training, data, train = material.description["training"], Dataset.open(shards), None
    is_other = training["shards_sha256"] != training_digest(data)
    known = training.get("data_sha256")
    if is_other and known is not None and known == configuration_digest(data) and "test" in errors:
        errors, train = {**training["errors"], "test": errors["test"]}, training["data_queries"]
    step = suggest(material, history, errors)
    if step is None:
        return None, []
    if is_other and train is None:
        return None, ["the fit had other training data; evaluate it on them for advice"]
    command = step.command(material.config, training["seconds"], data, folder, train)
    return command, [step.reason if command is None else f"{step.reason}:\n  {command}"]
