"""Which runs a study plans for its time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product

from mbtf_core.config.nested import nested
from mbtf_fit.config import DEFAULT_MODEL
from mbtf_fit.presets import best_options
from mbtf_pipeline.cost.repeats import FEWEST_SEEDS
from mbtf_pipeline.cost.runs import DataRequest, Run
from mbtf_pipeline.time_split import round_down

# Shares of a study's time. The generator gets its own; runs get theirs for two seeds each. The rest is left
# for start-up, the test set and evaluation.
GENERATOR = 0.1
RUN_SHARES = {"whole": 0.42, "models": 0.15, "data": 0.13}
# Total times of complete runs, seconds: this one, twice, four times, ...; the share of each that generates.
SHORTEST = 8.0
SHARE, OTHER_SHARES = 0.35, (0.6, 0.15)
# Paths per query of the data, and the total paths at which they are compared, relative to their mean.
PATHS = (2, 4, 16, 64)
TOTAL_PATHS = (0.4, 1.6)
# The series of fits with the options of the quality presets.
PRESET = f"{DEFAULT_MODEL} of the presets"
# Models as in their papers, and networks of other sizes.
MODELS_OF_PAPERS = ("neumip", "neumip-baseline")
SIZES: dict[str, dict[str, object]] = {
    "40 wide": {"width": 40},
    "40 wide, 12 channels, z": {"width": 40, "channels": 12, "encoding": {"direction_xyz": True}},
    "64 wide, 16 channels, z": {"width": 64, "channels": 16, "encoding": {"direction_xyz": True}},
}
_FEWEST_QUERIES = 20_000


def planned_runs(seconds: float, spp: int, path_seconds: float) -> list[Run]:
    """All runs of a study of so many seconds, in the order of measuring, each with the study's own seed.
    Queries have `spp` paths in the recipe, each of which takes `path_seconds` to generate."""

    def data(length: float) -> DataRequest:
        """The queries of the recipe that take so many seconds."""
        return DataRequest(round_down(max(_FEWEST_QUERIES, length / (spp * path_seconds))), spp)

    planners = {"whole": _whole, "models": _models, "data": _data}
    return [
        run
        for study, share in RUN_SHARES.items()
        for run in planners[study](share * seconds / FEWEST_SEEDS, data)
    ]


def _preset(seconds: float) -> dict[str, object]:
    """A fit with the options of the quality presets."""
    return nested({"model": DEFAULT_MODEL, **best_options(seconds), "training.time": f"{seconds:.3g}s"})


def _plain(model: str, seconds: float, **network: object) -> dict[str, object]:
    """A fit as in the paper of its model, except for `network`."""
    training = {"time": f"{seconds:.3g}s", "noise_regularization": 0.0}
    return {"model": model, "network": network, "training": training}


def _whole(seconds: float, data: Callable[[float], DataRequest]) -> Iterator[Run]:
    """Runs of doubling total time; the remaining time goes to other shares of generating, shortest first."""
    totals = [SHORTEST]
    while sum(totals) + 2 * totals[-1] <= seconds:
        totals.append(2 * totals[-1])
    left = seconds - sum(totals)
    planned = [(total, SHARE) for total in totals]
    for total, share in product(totals, OTHER_SHARES):
        if total <= left:
            planned.append((total, share))
            left -= total
    for total, share in planned:
        series, fit = f"{100 * share:.0f} % of the time for generating", _preset((1 - share) * total)
        yield Run("whole", series, f"planned for {total:g} s", data(share * total), fit)


def _data(seconds: float, data: Callable[[float], DataRequest]) -> Iterator[Run]:
    """Data of equal total paths, divided among many or few queries, each with an equally long fit."""
    each = seconds / (len(TOTAL_PATHS) * len(PATHS))
    mean = data(each / 3)
    for n, factor in product(PATHS, TOTAL_PATHS):
        queries = max(_FEWEST_QUERIES, int(factor * mean.spp * mean.queries) // n)
        name = f"{queries * n / 1e6:.3g} M paths"
        yield Run("data", f"{n} paths per query", name, DataRequest(queries, n), _preset(2 * each / 3))


def _models(seconds: float, data: Callable[[float], DataRequest]) -> Iterator[Run]:
    """Models and network sizes over training time, on one data set."""
    generating = 1.5
    unit = seconds / (generating + 3 * (1 + len(MODELS_OF_PAPERS)) + 2 * len(SIZES))
    shared = data(generating * unit)
    fits = [(PRESET, t, _preset(t)) for t in (unit, 2 * unit)]
    fits += [(model, t, _plain(model, t)) for model in MODELS_OF_PAPERS for t in (unit, 2 * unit)]
    fits += [(f"neumip, {s}", 2 * unit, _plain("neumip", 2 * unit, **net)) for s, net in SIZES.items()]
    for series, length, fit in fits:
        yield Run("models", series, f"{length:.3g} s of training", shared, fit)
