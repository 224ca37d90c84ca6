"""Validation during training: the set, and the error on it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mbtf_core.data.dataset import Dataset
from mbtf_core.stats import Estimate, level_groups, unexplained_variance
from mbtf_fit.data.loader import Partition, load_split
from mbtf_fit.data.queries import ShardQueries
from mbtf_fit.training.trainer import Trainer

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
