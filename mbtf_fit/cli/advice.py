"""The next command after a fit or its evaluation."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mbtf_core.data.folder import DataFolder
    from mbtf_fit.material.material import Material

# Least share of the stored training queries that a fit trains on.
_LEAST_SHARE = 0.75


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
    from mbtf_fit.training.next_step import next_step
    from mbtf_fit.training.validation import marginal_cost_of

    config, training = material.config, material.description["training"]
    cost = marginal_cost_of(history, errors, training.get("noise_variance"), kept_step(training))
    if cost is None or not errors or config.training.shared_decoder or reached(config, history):
        return None, []
    data = Dataset.open(shards)
    stored = data.manifest["splits"].get("train", {}).get("queries", 0)
    # Those of the training are the stored ones but for the held-out ones.
    if not _LEAST_SHARE * stored <= training["queries"] <= stored:
        line = "the fit had other training data: evaluate it on them to see what would reduce its error"
        return None, [f"{line} ({stored:,} training queries here, {training['queries']:,} in its training)"]
    step = next_step(cost, errors)
    command = step.command(config, training["seconds"], data, folder)
    return command, [step.reason if command is None else f"{step.reason}:\n  {command}"]
