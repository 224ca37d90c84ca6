"""The measurements of a cost study: which are made, in which order, and how long each is expected to take."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import count, takewhile

from mbtf_core.errors import MbtfError, PartialError
from mbtf_core.run.task import failure
from mbtf_core.units import clock
from mbtf_pipeline.cost.generator import benchmark_of, generator_configurations, path_seconds
from mbtf_pipeline.cost.measurement import (
    Conditions,
    Configuration,
    Measurement,
    MeasurementFolder,
)
from mbtf_pipeline.cost.runs import (
    GENERATOR,
    RUNS_ALONE,
    TEST,
    Run,
    planned_runs,
)

# Seconds by which a run exceeds generating and training until one has been measured: of a short fit of the
# default model, 5 besides training, and 2 of its evaluation.
OVERHEAD = 7.0
# By how much the generator's configurations exceed their share, as kernels are compiled.
COMPILING = 1.2
RESUMES = "the same command resumes"


@dataclass
class Measurements:
    """The measurements of a study by the label of their configuration, stored as they come.

    Attributes
    ----------
    conditions, store : what a measurement needs, and where the results are kept
    note : called when a configuration is taken, with its label and the time that it is expected to take
    failed : why runs failed
    path_seconds, step_seconds : seconds of generating a query over its number of paths; of a training step
    """

    conditions: Conditions
    store: MeasurementFolder
    note: Callable[[str], None] = lambda label: None
    found: dict[str, Measurement] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)
    path_seconds: float = 0.0
    step_seconds: float = 0.0
    # Whether a run has made the test set.
    tested: bool = False
    # Seconds of measured runs besides the test set, generating and training.
    _besides: list[float] = field(default_factory=list)

    @property
    def overhead(self) -> float:
        """Seconds that a run takes besides the test set, generating and training, at most."""
        return max(self._besides, default=OVERHEAD)

    @cached_property
    def configurations(self) -> list[Configuration]:
        """Those of the generator, the most important first."""
        return list(generator_configurations(benchmark_of(self.conditions)))

    def of_generator(self) -> list[Measurement]:
        """Measurements of the generator's configurations."""
        return [self.found[c.label] for c in self.configurations if c.label in self.found or self.recall(c)]

    def recall_rate(self, spp: int) -> bool:
        """Set `path_seconds` by what is measured of the generator with about so many paths;
        whether any is."""
        found = self.of_generator()
        if found:
            self.path_seconds = path_seconds(found, spp)
        return bool(found)

    def plan_runs(self, seconds: float, spp: int) -> list[Run]:
        """The runs of a study: the first one, by whose steps the others are planned once it is measured."""
        first = planned_runs(0.0, spp, self.path_seconds)[0]
        if self.recall(first):
            self.step_seconds = _step_seconds(self.found[first.label])
        runs = planned_runs(seconds, spp, self.path_seconds, self.step_seconds)
        return runs if first in runs else [first, *runs]

    def recall(self, configuration: Configuration) -> bool:
        """Whether a measurement is stored; it then counts as found."""
        stored = self.store.get(configuration)
        if stored is not None:
            self._add(configuration, stored)
        return stored is not None

    def _add(self, configuration: Configuration, measurement: Measurement) -> None:
        if isinstance(configuration, Run) and configuration.label not in self.found:
            planned = configuration.planned_seconds(self.path_seconds, _step_seconds(measurement))
            self._besides.append(measurement.details["run_seconds"] - planned)
        self.found[configuration.label] = measurement

    def measure(self, wanted: Iterable[Configuration], *, independent: bool) -> None:
        """Measure configurations, one after the other.

        One that fails says nothing about others that are `independent`; its error is raised for those that
        are not. A PartialError where the disk is full.
        """
        for configuration in wanted:
            label, left = configuration.label, ""
            if isinstance(configuration, Run):
                left = f", about {clock(self.expected_seconds(configuration))}"
            self.note(label + left)
            try:
                measured = configuration.measure(self.conditions)
            except PartialError as error:
                what = failure(error)["error"]
                raise PartialError(f"{label} failed: {what}", hint=error.hint or RESUMES) from None
            except MbtfError as error:
                if not independent:
                    raise
                # The other runs are worth a page all the same.
                self.failed[label] = failure(error)["error"]
                continue
            self._add(configuration, measured)
            self.note(f"{label}: done")
            self.store.put(configuration, measured)
            self.tested = self.tested or isinstance(configuration, Run)

    def expected_seconds(self, run: Run) -> float:
        """Expected seconds of measuring a run, the first one with the test set."""
        planned = run.planned_seconds(self.path_seconds, self.step_seconds)
        test = 0.0 if self.tested else TEST[0] * TEST[1] * self.path_seconds
        return planned + test + self.overhead

    def fits(self, run: Run, seconds: float) -> bool:
        """Whether a run can begin and finish in a time."""
        return seconds > self.expected_seconds(run)

    def group(self, run: Run) -> list[Measurement]:
        """The measurements of a run with the first seeds, without gaps."""
        labels = (replace(run, seed=seed).label for seed in count())
        return [self.found[label] for label in takewhile(self.found.__contains__, labels)]

    def measure_runs(self, runs: Sequence[Run], fits: Callable[[Run], bool]) -> None:
        """Measure runs in their order, while they fit into the remaining time."""

        def missing() -> Iterator[Run]:
            for run in runs:
                failed = {run.label, replace(run, seed=0).label} & self.failed.keys()
                if not failed and not self.recall(run) and fits(run):
                    yield run

        self.measure(missing(), independent=True)


def generator_seconds(seconds: float) -> float:
    """Time of a study for comparisons of the generator."""
    return GENERATOR * max(0.0, seconds - RUNS_ALONE)


def _step_seconds(run: Measurement) -> float:
    return run.details["training_seconds"] / run.details["training_steps"]
