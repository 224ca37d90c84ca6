"""Chains measured again with other seeds, until their error bars are narrow enough."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from mbtf_core.errors import InputError
from mbtf_pipeline.cost_study.measurements import HALF_WIDTH, NORMAL, Point, PointFolder
from mbtf_pipeline.cost_study.runs import Chain, RunRunner
from mbtf_pipeline.cost_study.seed_variance import Scatter, bar_of, mean_of

# Seeds that a chain is measured with before its own bars say whether more would help, and at most.
FEWEST_SEEDS, MOST_SEEDS = 3, 12


@dataclass
class Repeats:
    """What came of it.

    Attributes
    ----------
    again : by place of a point of the study, the same chain with other seeds
    failed : chains that could not be fitted with another seed, and why
    """

    again: dict[int, list[Point]] = field(default_factory=dict)
    failed: list[str] = field(default_factory=list)


def _worth_more(seeds: Sequence[Point], scatter: Scatter) -> bool:
    """Whether the mean of these is not known well enough, and more of them could make it so."""
    error = mean_of(seeds).error
    wanted = HALF_WIDTH / NORMAL * error.value
    if len(seeds) >= MOST_SEEDS or not bar_of(seeds, scatter) > wanted:
        return False
    # What the test queries leave open no seed narrows; but how much that is varies with the fit.
    return len(seeds) < FEWEST_SEEDS or error.error < wanted


def repeat_chains(
    points: Sequence[Point],
    chains: Mapping[int, Chain],
    scatter: Scatter,
    store: PointFolder,
    work: RunRunner,
    enough: Callable[[Chain, bool], bool],
    failed: Collection[Mapping[str, Any]] = (),
) -> Repeats:
    """Seed after seed the chains whose bars are too wide, those of like data together.

    Parameters
    ----------
    points : of the study so far; chains : those of them that may be repeated, by their place
    store : keeps what was measured, so that nothing is measured twice; what is there already counts in any
        case
    failed : keys of chains that could not be fitted before
    enough : whether time is left for a chain; its second argument: whether its data are still to be made
    """
    out = Repeats()
    left = dict(chains)
    for seed in range(1, MOST_SEEDS):
        done = {place: replace(chain, data=replace(chain.data, seed=seed)) for place, chain in left.items()}
        # The chains that the scatter was measured on are such repetitions.
        known = {k: store.get("seeds", c.key) or store.get(c.study, c.key) for k, c in done.items()}
        todo = [
            (place, chain)
            for place, chain in done.items()
            if known[place] is None
            and chain.key not in failed
            and _worth_more([points[place], *out.again.get(place, ())], scatter)
        ]
        needed = [chain.data for _, chain in todo]
        for number, (place, chain) in enumerate(todo):
            if enough(chain, not work.has(chain.data)):
                try:
                    point = work.measure(chain)
                except InputError as error:
                    # The same seed would fail the same way, and so end every run of this study.
                    out.failed.append(f"{chain.label}: {error.what}")
                    del left[place]
                else:
                    store.put(chain.key, point)
                    known[place] = point
            if chain.data not in needed[number + 1 :]:
                work.forget(chain.data)
        for place, found in known.items():
            if found is not None:
                out.again.setdefault(place, []).append(found)
        if not any(known.values()):
            break
    return out
