"""The next command after a fit or its evaluation."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mbtf_core.data.folder import DataFolder
    from mbtf_fit.material.material import Material


def advise(
    material: Material,
    folder: Path,
    shards: Path | DataFolder,
    history: list[dict[str, Any]],
    errors: dict[str, Any],
) -> tuple[str | None, list[str]]:
    """What reduces the error of a fit most.

    Parameters
    ----------
    material : the fit
    folder : its folder
    shards : the data set that `errors` are of
    history : records of its validations
    errors : by split

    Returns
    -------
    (str or None, list of str)
        The command; and the lines that say why, with it. Neither where the fit is unfinished, has reached the
        error that it was asked for, or shares a network.
    """
    from mbtf_core.data.dataset import Dataset
    from mbtf_fit.training.endings import kept_step, reached
    from mbtf_fit.training.fit_folder import training_digest
    from mbtf_fit.training.next_step import next_step
    from mbtf_fit.training.validation import marginal_cost_of

    config, training = material.config, material.description["training"]
    cost = marginal_cost_of(history, errors, training.get("noise_variance"), kept_step(training))
    if cost is None or not errors or config.training.shared_decoder or reached(config, history):
        return None, []
    data = Dataset.open(shards)
    if training["shards_sha256"] != training_digest(data):
        return None, ["the fit had other training data; evaluate it on them for advice"]
    step = next_step(cost, errors)
    command = step.command(config, training["seconds"], data, folder)
    return command, [step.reason if command is None else f"{step.reason}:\n  {command}"]
