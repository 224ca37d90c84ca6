"""``mbtf-fit evaluate``: errors of a material on a data set, and advice on them."""

from __future__ import annotations

from pathlib import Path

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import Verbose
from mbtf_fit.cli.results import report_errors


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
    from mbtf_fit.training.next_step import advise

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
