"""``mbtf-fit evaluate``: errors of a material on a data set, and advice on them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import Verbose
from mbtf_fit.formatting import report_errors

if TYPE_CHECKING:
    from mbtf_core.data.folder import DataFolder
    from mbtf_fit.material.material import Material
    from mbtf_fit.training.next_step import NextStep


def evaluate(
    material: Path, shards: Path, /, *, verbose: Verbose = False, console: Console = CONSOLE
) -> None:
    """Measure the errors of a material, free of the data's noise.

    The predictions of other code are evaluated too. Measured data have one value per query: errors on them
    include their noise, and say so. Advice on what reduces the error comes last.

    No fit is trained on test queries and held-out directions. --verbose adds the training queries, and
    errors by level of detail and by elevation.

    Parameters
    ----------
    material
        Folder made by mbtf-fit; or an npz file with the array 'value' (n, 3): predictions, by any code, for
        the test queries in the order of the shards.
    shards
        Folder made by mbtf-gen, or its URL.
    """
    from mbtf_core.data.dataset import Dataset
    from mbtf_core.data.folder import DataFolder
    from mbtf_fit.evaluation import evaluate, foreign_inputs, score_predictions
    from mbtf_fit.material.material import Material
    from mbtf_fit.training.fit_folder import read_history

    folder = DataFolder.open(shards)
    if material.suffix == ".npz":
        found = score_predictions(material, folder)
        lines = [f"{material}: predictions on {folder}", *report_errors(found["errors"], None, verbose)]
        console.report({"predictions": material, "shards": shards, **found}, "\n".join(lines))
        return
    loaded = Material.load(material)
    foreign = foreign_inputs(loaded, Dataset.open(folder))
    if foreign:
        console.note(
            f"warning: {folder} was made from another material than {material} was trained on "
            f"({', '.join(foreign)} differ{'s' if len(foreign) == 1 else ''}); the errors compare two "
            "materials and do not measure the quality of the fit"
        )
    found = evaluate(loaded, folder)
    history = [] if foreign else read_history(material)
    advice = advise(loaded, folder, history, found["errors"])
    lines = [
        f"{material}: {loaded.model.name} on {folder}",
        *report_errors(found["errors"], found.get("transmittance"), verbose, foreign=bool(foreign)),
        *([] if advice is None else [advice]),
    ]
    report = {"material": material, "shards": shards, "foreign_inputs": foreign, **found}
    report["advice"] = advice
    console.report(report, "\n".join(lines))


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
