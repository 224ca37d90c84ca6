"""Runs repeated with other seeds, and the error bars that follow.

Another seed generates other data and another test set, and starts from other weights. A configuration that
was run n times is reported with the mean of its errors, and the standard error s / √n. The relative standard
deviation s is pooled over all repeated configurations, with the sum of (n - 1) as its degrees of freedom, so
two runs of each are enough. A configuration of three runs or more uses its own standard deviation where that
is larger. And s is no less than the error of the test set: all runs of a seed share it, so few seeds can miss
it.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from mbtf_core.errors import InputError
from mbtf_core.stats import Estimate
from mbtf_pipeline.cost_study.measurements import HALF_WIDTH, NORMAL, Measurement, MeasurementFolder
from mbtf_pipeline.cost_study.runs import Run, RunRunner

# Seeds that every configuration gets, and at most; the fewest whose own deviation counts.
FEWEST_SEEDS, MOST_SEEDS = 2, 12
FEWEST_OWN = 3


def seed_deviation(groups: Sequence[Sequence[Measurement]]) -> Estimate | None:
    """Relative standard deviation of the error over seeds, pooled over configurations; each group holds the
    runs of one configuration. None without any repeat."""
    squares, dof = 0.0, 0
    for group in groups:
        errors = _errors(group)
        if len(errors) > 1:
            squares += (len(errors) - 1) * _relative_variance(errors)
            dof += len(errors) - 1
    if dof == 0:
        return None
    value = math.sqrt(squares / dof)
    return Estimate(value, value / math.sqrt(2 * dof), dof)


def _errors(group: Sequence[Measurement]) -> list[float]:
    return [m.error.value for m in group if math.isfinite(m.error.value) and m.error.value > 0]


def _relative_variance(errors: Sequence[float]) -> float:
    return statistics.variance(errors) / statistics.fmean(errors) ** 2


def combined(group: Sequence[Measurement], deviation: Estimate | None) -> Measurement:
    """The runs of one configuration as one measurement: name and command of the first one, means of all."""
    n = len(group)
    error = statistics.fmean(m.error.value for m in group)
    spread = 0.0 if deviation is None else deviation.value * error
    if len(_errors(group)) >= FEWEST_OWN:
        spread = max(spread, statistics.stdev(_errors(group)))
    test = math.sqrt(statistics.fmean(m.error.error**2 for m in group))
    times = [m.seconds.value for m in group]
    jitter = statistics.stdev(times) / math.sqrt(n) if n > 1 else 0.0
    details = {k: statistics.fmean(m.details[k] for m in group) for k in group[0].details}
    return replace(
        group[0],
        seconds=Estimate(statistics.fmean(times), jitter, n),
        error=Estimate(error, max(spread, test) / math.sqrt(n), group[0].error.n),
        details={**details, "seeds": float(n)},
    )


def _is_wide(group: Sequence[Measurement], deviation: Estimate | None) -> bool:
    """Whether the 95 % interval is too wide."""
    return NORMAL * combined(group, deviation).error.relative_error > HALF_WIDTH


@dataclass
class Repeated:
    """Measurements by configuration in the order of the plan, one per seed, and the runs that failed."""

    groups: list[list[Measurement]]
    failed: list[str]


def measure_runs(
    runs: Sequence[Run], store: MeasurementFolder, runner: RunRunner, fits: Callable[[Run], bool], seeds: int
) -> Repeated:
    """Measure every run with two seeds before the next one, then runs whose 95 % interval is too wide with
    further seeds; store every measurement.

    Parameters
    ----------
    fits : whether a run fits into the remaining time
    seeds : number of seeds that may be measured; stored measurements count in any case
    """
    out = Repeated([[] for _ in runs], [])
    broken: set[int] = set()

    def measure(tasks: Sequence[tuple[int, Run]]) -> None:
        deviation = seed_deviation(out.groups)
        for number, (k, task) in enumerate(tasks):
            group, seed = out.groups[k], task.data.seed
            found = store.get(task.study, task.key) if len(group) == seed else None
            wanted = found is None and len(group) == seed < seeds and k not in broken
            if wanted and (seed < FEWEST_SEEDS or _is_wide(group, deviation)) and fits(task):
                try:
                    found = runner.measure(task)
                    store.put(task.key, found)
                except InputError as error:
                    # The other runs are worth a page all the same.
                    out.failed.append(f"{task.label}: {error.what}")
                    broken.add(k)
            if found is not None:
                command = runner.command_of(runs[k])
                group.append(replace(found, series=task.series, name=task.name, command=command))
            if all(other.data != task.data for _, other in tasks[number + 1 :]):
                runner.forget(task.data)

    def with_seed(k: int, seed: int) -> tuple[int, Run]:
        return k, replace(runs[k], data=replace(runs[k].data, seed=seed))

    places = range(len(runs))
    measure([with_seed(k, seed) for k in places for seed in range(FEWEST_SEEDS)])
    for seed in range(1, MOST_SEEDS):
        measure([with_seed(k, seed) for k in places])
    return out
