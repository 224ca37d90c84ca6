"""Validation during training: the set, the error on it, and the history of records."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.data.dataset import Dataset
from mbtf_core.files.atomic import write_text
from mbtf_core.stats import Estimate, level_groups, unexplained_variance
from mbtf_fit.data.loader import Partition, load_split
from mbtf_fit.data.queries import ShardQueries
from mbtf_fit.formatting import format_estimate
from mbtf_fit.training.trainer import Trainer

HISTORY_NAME = "metrics.jsonl"
# Queries of the validation subset, and the fewest test queries that are preferred over held-out queries.
_SUBSET, _FEWEST = 1 << 14, 1 << 12


def validation_set(data: Dataset, partition: Partition) -> tuple[str, ShardQueries]:
    """(name among the errors, queries) of the set on which the error is tracked.

    The test split, because it has more paths per query: four paths often do not resolve the error of glossy
    materials. The held-out queries where there is no test split, or a small one. No option is selected by it.
    """
    held_out = partition.held_out_queries
    test = load_split(data, "test") if "test" in data.splits and data.shards("test") else None
    if test is not None and len(test) >= min(len(held_out), _FEWEST):
        return "test", test
    return "held_out_queries", held_out


def validation_subset(positions: int, queries: ShardQueries, most: int = _SUBSET) -> ShardQueries:
    """At most `most` queries, evenly spread over the set; fewer for a model that reads its textures at many
    positions per query. A copy, so that the set itself can be released."""
    most = max(most // positions, most // 16)
    return queries.take(np.arange(0, len(queries), max(1, math.ceil(len(queries) / most))))


def validation_error(trainer: Trainer, queries: ShardQueries) -> Estimate:
    """Unexplained variance of queries by the current model."""
    return unexplained_variance(trainer.predict(queries), queries.value_a, queries.value_b)


def finite(number: float | None) -> float | None:
    """A number, or None where it is not finite; JSON and plots have no others."""
    return number if number is not None and math.isfinite(number) else None


def errors_by_level(trainer: Trainer, queries: ShardQueries) -> dict[str, float | None]:
    """Unexplained variance by nearest level; None where it is undefined."""
    predicted = trainer.predict(queries)
    level = level_groups(queries.sigma, trainer.model.lattice.finest)
    out = {}
    for s in np.unique(level):
        rows = level == s
        arrays = (predicted[rows], queries.value_a[rows], queries.value_b[rows])
        value = unexplained_variance(*arrays).value
        out[str(s)] = finite(value)
    return out


def history_record(trainer: Trainer, subset: ShardQueries) -> dict[str, Any]:
    """Progress and validation error of the current model."""
    state = trainer.progress
    found = validation_error(trainer, subset).as_dict() if len(subset) else {}
    return {
        "step": state.step,
        "seconds": round(state.seconds, 3),
        "fraction": round(trainer.fraction, 5),
        "loss": state.loss,
        "unexplained": found.get("value"),
        "unexplained_error": found.get("error"),
        "queries_per_second": round(state.step * trainer.batch / max(state.seconds, 1e-9)),
    }


def append_history(folder: Path, record: dict[str, Any]) -> None:
    """Add a record to the history of a fit."""
    with (folder / HISTORY_NAME).open("a", encoding="utf-8") as stream:
        stream.write(json.dumps(record) + "\n")


def truncate_history(folder: Path, step: int) -> None:
    """Remove the records after a step, to which a fit returns; all of them at step 0."""
    if step == 0:
        (folder / HISTORY_NAME).unlink(missing_ok=True)
        return
    kept = [line for line in read_history(folder) if line.get("step", 0) <= step]
    write_text(folder / HISTORY_NAME, "".join(json.dumps(line) + "\n" for line in kept))


def describe_record(record: dict[str, Any]) -> str:
    """One line for the progress bar."""
    text = f"loss {record['loss']:.3f}"
    if record["unexplained"] is not None:
        estimate = {"value": record["unexplained"], "error": record["unexplained_error"]}
        text += f", validation error {format_estimate(estimate)}"
    return f"{text}, {record['queries_per_second'] / 1e6:.2f} M queries/s"


def read_history(folder: str | Path) -> list[dict[str, Any]]:
    """Read the validation history of a fit; records after a corrupt line are left out.

    Parameters
    ----------
    folder : str or Path
        Folder of the material.

    Returns
    -------
    list of dict
        One record per validation, in order of time:

        step : int
            Steps done.
        seconds : float
            Training time in seconds.
        fraction : float
            Fraction of the budget that is spent, in [0, 1].
        loss : float
            Mean training loss since the record before.
        unexplained, unexplained_error : float or None
            Unexplained variance of the validation subset (1 - R²), and its standard error.
        queries_per_second : int
            Training throughput.
    """
    path = Path(folder) / HISTORY_NAME
    out = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else []:
        try:
            record = json.loads(line)
        except (ValueError, RecursionError):
            break
        if not isinstance(record, dict):
            break
        out.append(record)
    return out
