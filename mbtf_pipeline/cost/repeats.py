"""Runs repeated with other seeds, and the error bars that follow.

Another seed generates other data and another test set, and starts from other weights. A configuration that
was run n times is reported with the mean of its errors, and the standard error s / √n. The relative standard
deviation s is pooled over all repeated configurations, so two runs of each are enough. It is no less than the
error of the test set: all runs of a seed share it, so few seeds can miss it.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import takewhile

from mbtf_core.stats import Estimate, mean_estimate
from mbtf_pipeline.cost.measurements import HALF_WIDTH, NORMAL, Measurement, MeasurementFolder
from mbtf_pipeline.cost.runs import Run, RunRunner

# Seeds that every configuration gets, and at most.
FEWEST_SEEDS, MOST_SEEDS = 2, 12


def seed_deviation(groups: Sequence[Sequence[Measurement]]) -> Estimate | None:
    """Relative standard deviation of the error over seeds, pooled over configurations with their degrees of
    freedom; each group holds the runs of one configuration. None without any repeat."""
    squares, dof = 0.0, 0
    for group in groups:
        errors = [m.error.value for m in group if m.error.value > 0]
        if len(errors) > 1:
            squares += (len(errors) - 1) * statistics.variance(errors) / statistics.fmean(errors) ** 2
            dof += len(errors) - 1
    if dof == 0:
        return None
    value = math.sqrt(squares / dof)
    return Estimate(value, value / math.sqrt(2 * dof), dof)


def combined(group: Sequence[Measurement], deviation: Estimate | None) -> Measurement:
    """The runs of one configuration as one measurement: name and command of the first one, means of all."""
    error = statistics.fmean(m.error.value for m in group)
    spread = 0.0 if deviation is None else deviation.value * error
    test = math.sqrt(statistics.fmean(m.error.error**2 for m in group))
    details = {k: statistics.fmean(m.details[k] for m in group) for k in group[0].details}
    return replace(
        group[0],
        seconds=mean_estimate([m.seconds.value for m in group]),
        error=Estimate(error, max(spread, test) / math.sqrt(len(group)), group[0].error.n),
        details={**details, "seeds": float(len(group))},
    )


def measure_runs(
    runs: Sequence[Run], store: MeasurementFolder, runner: RunRunner, fits: Callable[[Run], bool], seeds: int
) -> tuple[list[list[Measurement]], dict[int, str]]:
    """Measure every run with two seeds before the next one, then runs whose 95 % interval is too wide with
    further seeds, up to `seeds`, while they fit into the remaining time; store every measurement.

    Returns the measurements of every run, one per seed, and why runs failed, by their place in the plan.
    """
    found: dict[tuple[int, int], Measurement] = {}
    # Measured, or given to the runner.
    begun: set[tuple[int, int]] = set()
    failed: dict[int, str] = {}
    places = range(len(runs))

    def group(k: int) -> list[Measurement]:
        return [found[k, seed] for seed in takewhile(lambda seed: (k, seed) in found, range(MOST_SEEDS))]

    def missing(order: Sequence[tuple[int, int]], deviation: Estimate | None) -> Iterator[tuple[int, Run]]:
        """Runs to be measured; each is chosen when the runner takes it."""
        tasks = [(k, replace(runs[k], data=replace(runs[k].data, seed=seed))) for k, seed in order]
        for k, task in tasks:
            seed = task.data.seed
            if seed == 0 or (k, seed - 1) in begun:
                stored = store.get(task, runner.command_of(runs[k]))
                if stored is not None:
                    found[k, seed] = stored
                    begun.add((k, seed))
                elif k not in failed and (seed < FEWEST_SEEDS or too_wide(k, seed, deviation)) and fits(task):
                    begun.add((k, seed))
                    yield k, task

    def too_wide(k: int, seed: int, deviation: Estimate | None) -> bool:
        own = group(k)
        relative = combined(own, deviation).error.relative_error if len(own) == seed else 0.0
        return seed < seeds and NORMAL * relative > HALF_WIDTH

    rounds = [[(k, seed) for k in places for seed in range(FEWEST_SEEDS)]]
    rounds += [[(k, seed) for k in places] for seed in range(1, MOST_SEEDS)]
    for order in rounds:
        deviation = seed_deviation([group(k) for k in places])
        for k, task, measured in runner.measure_all(missing(order, deviation)):
            if isinstance(measured, str):
                # The other runs are worth a page all the same.
                failed[k] = f"{task.label}: {measured}"
                continue
            found[k, task.data.seed] = measured
            store.put(task, measured)
    return [group(k) for k in places], failed
