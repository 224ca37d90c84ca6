"""Chains of other seeds: as many as bars need, none twice, and means with the bars that they deserve."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.paths import ROOT

from mbtf_core.errors import InputError
from mbtf_core.stats import Estimate
from mbtf_pipeline.cost_study.measurements import HALF_WIDTH, Point, PointFolder
from mbtf_pipeline.cost_study.repeats import MOST_SEEDS, Repeats, repeat_chains
from mbtf_pipeline.cost_study.runs import Chain, RunRequest
from mbtf_pipeline.cost_study.seed_variance import bar_of, mean_of, seed_scatter, with_scatter
from mbtf_pipeline.recipe import load_recipe

# Relative deviation of fits between seeds, and standard error of the test queries.
SCATTER, JUDGED = 0.1, 0.02
FIT: dict[str, Any] = {"model": "neumip", "training": {"time": "5s"}}
TRUE = {"data": 0.2, "fit": 0.1, "chain": 0.05}


class FakeWorkshop:
    """Chains whose errors scatter as is known; each takes no time."""

    def __init__(self, scatter: float = SCATTER, judged: float = JUDGED) -> None:
        self.luck = cycle((0.8, -1.0, 1.0, -0.8, 0.3))
        self.scatter, self.judged = scatter, judged
        self.measured: list[Chain] = []
        self.held: set[RunRequest] = set()
        self.generated: list[RunRequest] = []

    def measure(self, chain: Chain) -> Point:
        self.measured.append(chain)
        if chain.data not in self.held:
            self.generated.append(chain.data)
            self.held.add(chain.data)
        true = TRUE["data" if chain.study == "seeds" else chain.study]
        error = true * math.exp(self.scatter * next(self.luck))
        setting = {
            "queries.train": str(chain.data.queries),
            "queries.spp": chain.data.spp,
            "model": chain.fit["model"],
        }
        if chain.data.seed:
            setting["seed"] = chain.data.seed
        return Point(
            chain.study,
            chain.series,
            chain.name,
            setting,
            "command",
            Estimate(5.0 + chain.data.seed, 0.0, 1),
            Estimate(error, self.judged * error, 1000),
            details={"total_seconds": 5.0 + chain.data.seed},
        )

    def has(self, data: RunRequest) -> bool:
        return data in self.held

    def forget(self, data: RunRequest) -> None:
        self.held.discard(data)


def chain(study: str, queries: int = 1000, seed: int = 0, name: str = "a chain") -> Chain:
    return Chain(study, "neumip", name, RunRequest(queries, 4, seed), FIT)


def measured(work: FakeWorkshop, store: PointFolder, tasks: list[Chain]) -> list[Point]:
    points = []
    for task in tasks:
        point = work.measure(task)
        store.put(task.key, point)
        points.append(point)
        work.forget(task.data)
    work.measured.clear()
    work.generated.clear()
    return points


def study(work: FakeWorkshop, store: PointFolder) -> tuple[list[Point], dict[int, Chain]]:
    """A chain that the scatter is measured on, two that share their data, and one more."""
    tasks = [
        chain("data"),
        *(chain("seeds", seed=n) for n in (1, 2, 3)),
        chain("fit", 2000, name="one"),
        chain("fit", 2000, name="two"),
        chain("chain", 3000),
    ]
    for n, task in enumerate(tasks):
        tasks[n] = replace(task, fit={**FIT, "name": task.name})
    points = measured(work, store, tasks)
    return points, {n: t for n, t in enumerate(tasks) if t.study != "seeds"}


def repeat(
    work: FakeWorkshop,
    store: PointFolder,
    points: list[Point],
    chains: dict[int, Chain],
    most: int = 10**6,
) -> Repeats:
    def enough(chain: Chain, data: bool) -> bool:
        return len(work.measured) < most

    scatter = seed_scatter(points)
    assert scatter is not None
    return repeat_chains(points, chains, scatter, store, work, enough)  # type: ignore[arg-type]


def test_chains_are_repeated_until_their_bars_are_narrow(tmp_path: Path) -> None:
    work, store = FakeWorkshop(), PointFolder(tmp_path, {})
    points, chains = study(work, store)
    again = repeat(work, store, points, chains).again
    scatter = seed_scatter(points)
    assert scatter is not None
    # The bars of the test queries stay, so that (d²/n + j²)^½ is within a tenth over 1.96.
    needed = math.ceil(scatter.of(points[0]) ** 2 / ((HALF_WIDTH / 1.96) ** 2 - JUDGED**2))
    assert 1 < needed < MOST_SEEDS
    seeds = {place: 1 + len(others) for place, others in again.items()}
    # More where a chain's own seeds scatter more.
    assert all(needed <= n <= MOST_SEEDS for n in seeds.values())
    assert seeds.keys() == chains.keys()
    # Three of the first one's were there; data that two chains share are made once for each seed.
    assert {c.data.seed for c in work.measured if c.study == "data"} == set(range(4, seeds[0]))
    assert len(work.generated) == len(set(work.generated))
    assert not work.held
    found = with_scatter(points, scatter, again)
    for place in chains:
        p = found[place]
        values = [q.error.value for q in (points[place], *again[place])]
        assert p.error.value == pytest.approx(np.mean(values))
        if seeds[place] < MOST_SEEDS:
            assert 1.96 * p.error.relative_error <= HALF_WIDTH
        least = math.hypot(JUDGED, scatter.of(p) / seeds[place] ** 0.5)
        assert p.error.relative_error >= least * (1 - 1e-9)
        assert p.details["seeds"] == seeds[place]
        assert p.seconds.value == p.details["total_seconds"] > 5.0
    # Their own points say what one seed does.
    assert found[1].details["seeds"] == 1


def test_nothing_is_measured_twice_and_more_time_goes_on(tmp_path: Path) -> None:
    work, store = FakeWorkshop(), PointFolder(tmp_path, {})
    points, chains = study(work, store)
    some = repeat(work, store, points, chains, most=2).again
    assert len(work.measured) == 2
    assert sum(map(len, some.values())) == 3 + 2
    again = repeat(work, store, points, chains).again
    assert len(work.measured) > 2
    keys = [str((c.study, c.key)) for c in work.measured]
    assert len(keys) == len(set(keys))
    assert all(again[place][: len(others)] == others for place, others in some.items())


@pytest.mark.parametrize(
    ("scatter", "judged", "seeds"), [(0.01, 0.02, {0: 4}), (0.1, 0.06, {0: 4, 4: 3, 5: 3, 6: 3})]
)
def test_no_more_seeds_than_bars_can_use(
    tmp_path: Path, scatter: float, judged: float, seeds: dict[int, int]
) -> None:
    """Of chains that scatter little only what is there already; where the test queries leave more open than
    is wanted, as many as tell whether that is so of other seeds too."""
    work, store = FakeWorkshop(scatter, judged), PointFolder(tmp_path, {})
    again = repeat(work, store, *study(work, store)).again
    assert {place: 1 + len(others) for place, others in again.items()} == seeds


def test_hopeless_scatter_ends(tmp_path: Path) -> None:
    work, store = FakeWorkshop(scatter=1.0), PointFolder(tmp_path, {})
    again = repeat(work, store, *study(work, store)).again
    assert {1 + len(others) for others in again.values()} == {MOST_SEEDS}


def test_a_seed_far_from_the_others_widens_the_bar(tmp_path: Path) -> None:
    work, store = FakeWorkshop(scatter=0.01), PointFolder(tmp_path, {})
    points, _ = study(work, store)
    scatter = seed_scatter(points)
    assert scatter is not None
    far = [replace(points[6], error=Estimate(e, 0.02 * e, 1000)) for e in (0.05, 0.05, 5.0)]
    assert bar_of(far, scatter) > 0.5 * mean_of(far).error.value
    assert bar_of(far[:2], scatter) < 0.1 * mean_of(far[:2]).error.value


def test_a_chain_that_fails_with_a_seed_ends_nothing(tmp_path: Path) -> None:
    class Failing(FakeWorkshop):
        def measure(self, chain: Chain) -> Point:
            if chain.data.seed == 2 and chain.study == "fit" and chain.name == "one":
                raise InputError("training diverged at step 7")
            return super().measure(chain)

    work, store = Failing(), PointFolder(tmp_path, {})
    found = repeat(work, store, *study(work, store))
    assert len(found.failed) == 1
    assert "one" in found.failed[0]
    assert "training diverged" in found.failed[0]
    assert len(found.again[4]) == 1
    assert len(found.again[5]) > 1


# Materials that a study has looked at.
checked: list[str] = []
# The module of studies, and the workshops that its studies have made.
Studied = tuple[Any, list[Any]]


@pytest.fixture
def studied(monkeypatch: pytest.MonkeyPatch) -> Studied:
    """Studies of a point of the generator and six chains, of which the first takes longer than there is."""
    from mbtf_pipeline.cost_study import study as module

    shops: list[Any] = []
    checked.clear()

    class Shop(FakeWorkshop):
        def __init__(self, config: Any, *_: Any) -> None:
            super().__init__()
            self.config = config
            shops.append(self)

        def command_of(self, chain: Chain) -> str:
            return "command"

        def clear(self) -> None:
            self.held.clear()

    second = Estimate(1.0, 0.1, 4)
    setting = Point("paths", "paths", "4", {}, "", second, second, None, second)
    long = replace(chain("chain", 3000), fit={**FIT, "training": {"time": "2h"}})
    tasks = [
        long,
        chain("data"),
        *(chain("seeds", seed=n) for n in (1, 2, 3)),
        chain("fit", 2000),
    ]
    task = SimpleNamespace(
        study="paths",
        series="paths",
        name="4",
        label="paths: paths, 4",
        key={},
        run=lambda *_: setting,
        command=lambda *_: "",
    )
    monkeypatch.setattr(module, "Workshop", Shop)
    monkeypatch.setattr(module, "generator_tasks", lambda bench: [task])
    monkeypatch.setattr(module, "_price", lambda points: lambda paths: 1e-9)
    monkeypatch.setattr(module, "_check_variation", lambda bench: checked.append(bench.config.material))
    monkeypatch.setattr(module, "_beyond_tracing", lambda *_: 0.0)
    monkeypatch.setattr(module, "chains", lambda *_: tasks)
    return module, shops


def test_a_study_repeats_chains_in_the_time_that_it_gets_for_it(studied: Studied, tmp_path: Path) -> None:
    """Without any, seeds that the scatter was measured on count all the same."""
    module, _ = studied
    recipe = load_recipe(ROOT / "pipelines/quickstart.yaml", [])
    first = module.run_study(recipe, tmp_path / "study", budget=3600.0)
    assert [p.details.get("seeds") for p in first.points] == [None, 4, 1, 1, 1, 1]
    assert first.skipped == ["chain: neumip, a chain"]
    # As the four seeds scatter, not as their mean and three of them do.
    values = [first.points[n].error.value for n in (2, 3, 4)]
    values.append(4 * first.points[1].error.value - sum(values))
    assert first.scatter is not None
    expected = np.std(np.log(values), ddof=1) / 0.9213
    assert first.scatter.deviations[0].value == pytest.approx(expected, rel=1e-3)
    second = module.run_study(recipe, tmp_path / "study", budget=3600.0, narrow=3600.0)
    assert second.points[5].details["seeds"] > 1
    assert second.points[5].error.error < first.points[5].error.error
    # No second is left for a chain of five.
    third = module.run_study(recipe, tmp_path / "other", budget=3600.0, narrow=4.0)
    assert third.points[5].details["seeds"] == 1
    assert module.budget_of(tmp_path / "other") == 3600.0
    assert module.budget_of(tmp_path / "none") == module.NEW_BUDGET


def test_points_of_other_seeds_and_materials_are_not_mixed(studied: Studied, tmp_path: Path) -> None:
    module, shops = studied
    recipe = load_recipe(ROOT / "pipelines/quickstart.yaml", [])
    wool = load_recipe(ROOT / "pipelines/quickstart.yaml", ["generate.material=assets/twisted_wool"])
    for asked, seed, measured in ((recipe, None, 5), (recipe, None, 0), (recipe, 7, 5), (wool, None, 5)):
        module.run_study(asked, tmp_path / "study", budget=3600.0, seed=seed)
        assert len(shops[-1].measured) == measured
        assert shops[-1].config.seed == (seed or 0)
    assert len(list((tmp_path / "study" / "points").iterdir())) == 3 * (5 + 1)
    assert [Path(material).name for material in checked] == 3 * ["turtle_shell"] + ["twisted_wool"]


def test_what_is_refused_leaves_the_study_that_is_there(
    studied: Studied, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another kind of machine, or a material with nothing to learn."""
    module, shops = studied
    recipe = load_recipe(ROOT / "pipelines/quickstart.yaml", [])
    folder = tmp_path / "study"
    module.run_study(recipe, folder, budget=3600.0)
    there = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}

    def refuse(bench: Any) -> None:
        raise InputError("reflects nothing")

    monkeypatch.setattr(module, "_check_variation", refuse)
    with pytest.raises(InputError, match="reflects nothing"):
        module.run_study(recipe, folder, budget=60.0, seed=5)
    monkeypatch.setattr(module, "machine", lambda: {"system": "Plan 9"})
    with pytest.raises(InputError, match="another kind of machine"):
        module.run_study(recipe, folder, budget=60.0)
    found = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file() and "lock" not in p.name}
    assert found == {p: content for p, content in there.items() if "lock" not in p.name}
    assert len(shops) == 1


def test_a_study_counts_paths_and_says_what_its_commands_take_besides(
    studied: Studied, tmp_path: Path
) -> None:
    module, shops = studied
    said = ["generate.queries.target_error=5%", "generate.queries.test=4096"]
    recipe = load_recipe(ROOT / "pipelines/quickstart.yaml", said)
    found = module.run_study(recipe, tmp_path / "study", budget=3600.0)
    assert shops[-1].config.queries.target_error is None
    # By the price that the fixture gives a query.
    assert found.test_seconds == pytest.approx(4096e-9)
    assert "target_error: null" in (tmp_path / "study" / module.CONFIG_NAME).read_text()


def test_a_chain_that_fails_leaves_the_others(
    studied: Studied, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module, shops = studied
    usual = FakeWorkshop.measure
    tried: list[RunRequest] = []

    def measure(self: FakeWorkshop, chain: Chain) -> Point:
        if chain.study == "fit" or chain.data.seed == 2:
            tried.append(chain.data)
            raise InputError("training diverged at step 7", where="here", hint="--rate 0.1")
        return usual(self, chain)

    monkeypatch.setattr(FakeWorkshop, "measure", measure)
    recipe = load_recipe(ROOT / "pipelines/quickstart.yaml", [])
    found = module.run_study(recipe, tmp_path / "study", budget=3600.0)
    assert [p.study for p in found.points] == ["paths", "data", "seeds", "seeds"]
    assert len(found.failed) == 2
    # Other programs' flags would not help here.
    assert all(text.endswith(": training diverged at step 7") for text in found.failed)
    assert found.skipped == ["chain: neumip, a chain"]
    # Three seeds still tell the scatter.
    assert found.scatter is not None
    # Tried again when the study goes on, but not once more as a repetition.
    assert len(tried) == 2
    again = module.run_study(recipe, tmp_path / "study", budget=3600.0, narrow=3600.0)
    assert len(tried) == 4
    assert len(again.failed) == 2
    assert {c.study for c in shops[-1].measured} <= {"data"}
