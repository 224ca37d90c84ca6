"""Which chains are measured within a time budget."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

from mbtf_core.config_file import nested
from mbtf_fit.presets import best_options
from mbtf_pipeline.cost_study.runs import Chain, RunRequest

# Shares of the budget; the generator's own studies take GENERATOR, what is left over is for starting up and
# judging. DATA pays for the chains of other seeds, too.
GENERATOR, DATA, FIT, WHOLE = 0.18, 0.22, 0.2, 0.3
# The shortest whole chain, seconds, the share of every chain that generates, and other shares that are tried.
SHORTEST = 60.0
SHARE = 0.35
OTHER_SHARES = (0.6, 0.15)
# Chains of other seeds at each of two sizes of data, which show how far chains scatter.
SEEDS = 3
PATHS = (2, 4, 16, 64)
# Path budgets at which they are compared, of the mean one.
PATH_SHARES = (0.4, 1.6)
# What fits with the options of the qualities are called; chains are made of these.
QUALITIES = "neumip of the qualities"
# Models as their papers have them, and networks of other sizes; the last two are those of the qualities
# without their smoothing.
MODELS = ("neumip", "neumip-baseline")
SIZES: dict[str, dict[str, object]] = {
    "16 wide": {"width": 16},
    "40 wide": {"width": 40},
    "40 wide, 12 channels, z": {"width": 40, "channels": 12, "encoding": {"direction_xyz": True}},
    "64 wide, 16 channels, z": {"width": 64, "channels": 16, "encoding": {"direction_xyz": True}},
}
_FEWEST_QUERIES = 20_000

# Seconds that a query of so many paths takes to generate.
Price = Callable[[int], float]


def _queries(seconds: float, spp: int, price: Price) -> int:
    """Queries that so many seconds buy, rounded to two digits."""
    count = max(_FEWEST_QUERIES, seconds / price(spp))
    digits = 10 ** max(0, len(str(int(count))) - 2)
    return int(round(count / digits) * digits)


def _fit(model: str, seconds: float, network: dict[str, object] | None = None) -> dict[str, object]:
    """Options of a fit with a model as its paper has it, but for what `network` says."""
    options = {} if network is None else {"network": network}
    return {"model": model, "training": {"time": f"{seconds:.3g}s", "noise_regularization": 0.0}, **options}


def _best(seconds: float) -> dict[str, object]:
    """Options of a fit as the qualities have it."""
    return nested({"model": "neumip", **best_options(seconds), "training.time": f"{seconds:.3g}s"})


def chains(budget: float, spp: int, price: Price) -> Iterator[Chain]:
    """All chains that a budget in seconds allows.

    Parameters
    ----------
    spp : paths per query of the recipe
    price : seconds that a query takes to generate, by its number of paths
    """
    yield from _whole(WHOLE * budget, spp, price)
    yield from _data(DATA * budget, spp, price)
    yield from _fits(FIT * budget, spp, price)


def _whole(budget: float, spp: int, price: Price) -> Iterator[Chain]:
    """Chains planned for one minute in all, two, four, … as far as the budget goes; what is left goes to
    other splits of them, the shortest first."""
    totals = [SHORTEST]
    while sum(totals) + 2 * totals[-1] <= budget:
        totals.append(2 * totals[-1])
    wanted = [(total, SHARE) for total in totals]
    spent = sum(totals)
    for total in totals:
        for share in OTHER_SHARES:
            if spent + total <= budget:
                wanted.append((total, share))
                spent += total
    for total, share in wanted:
        queries = _queries(share * total, spp, price)
        series, name = f"{share:.0%} of the time generating", f"planned for {total:g} s"
        yield Chain("chain", series, name, RunRequest(queries, spp), _best((1 - share) * total))


def _data(budget: float, spp: int, price: Price) -> Iterator[Chain]:
    """Queries and paths at equal numbers of paths, and the same setting with other seeds."""
    # On average a point generates for a third of its time and trains for the rest.
    each = budget / (len(PATH_SHARES) * (len(PATHS) + SEEDS))
    paths = spp * _queries(each / 3, spp, price)
    # Bars of all chains rest on these; the recipe's number of paths per query is what most chains have.
    usual = min(PATHS, key=lambda n: abs(n - spp))
    for n in PATHS:
        for share in PATH_SHARES:
            queries = max(_FEWEST_QUERIES, int(share * paths) // n)
            name = f"{queries * n / 1e6:.3g} M paths"
            chain = Chain("data", f"{n} paths/query", name, RunRequest(queries, n), _best(2 * each / 3))
            yield chain
            if n == usual:
                for other in range(1, SEEDS + 1):
                    data = RunRequest(queries, n, other)
                    yield replace(chain, study="seeds", name=f"{name}{data.other}", data=data)


def _fits(budget: float, spp: int, price: Price) -> Iterator[Chain]:
    """Models and sizes over training time, on one data set."""
    unit = budget / 18.5
    data = RunRequest(_queries(1.5 * unit, spp, price), spp)

    def chain(series: str, seconds: float, fit: dict[str, object]) -> Chain:
        return Chain("fit", series, f"{seconds:.3g} s", data, fit)

    for seconds in (unit, 2 * unit):
        yield chain(QUALITIES, seconds, _best(seconds))
        for model in MODELS:
            yield chain(model, seconds, _fit(model, seconds))
    for size, network in SIZES.items():
        yield chain(f"neumip, {size}", 2 * unit, _fit("neumip", 2 * unit, network))
