"""Whole chains of a cost study: which are made, what they cost and leave."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mbtf_gen.config.generator import GeneratorConfig
from mbtf_pipeline.cost_study.fit_runs import DATA, FIT, GENERATOR, SHORTEST, WHOLE, chains
from mbtf_pipeline.cost_study.measurements import PointFolder
from mbtf_pipeline.cost_study.runs import RunRequest


@pytest.mark.parametrize("budget", [600.0, 900.0, 3600.0])
def test_chains_fit_into_their_budget(budget: float) -> None:
    def price(spp: int) -> float:
        return spp * 5e-7

    found = list(chains(budget, 4, price))
    assert {c.study for c in found} == {"chain", "data", "fit", "seeds"}
    made: set[RunRequest] = set()
    spent = dict.fromkeys(("data", "fit", "chain", "seeds"), 0.0)
    for chain in found:
        spent[chain.study] += chain.seconds(price, data=chain.data not in made)
        made.add(chain.data)
    spent["data"] += spent.pop("seeds")
    assert 0.4 * budget < sum(spent.values()) < (1.0 - GENERATOR) * budget
    for study, share in (("data", DATA), ("fit", FIT), ("chain", WHOLE)):
        assert spent[study] <= 1.05 * share * budget
    # Equal numbers of paths are compared, whatever their number per query.
    budgets = {c.data.queries * c.data.spp for c in found if c.study == "data"}
    assert len(budgets) == 2
    # From a minute upwards, each twice as long as the one before, as far as the budget goes.
    whole = [c for c in found if c.study == "chain"]
    totals = sorted({round(c.seconds(price) / SHORTEST) for c in whole})
    assert totals == [2**n for n in range(len(totals))]
    assert sum(totals) <= WHOLE * budget / SHORTEST < sum(totals) + 2 * totals[-1]
    # Chains of other seeds, of data and fit, are of two settings that were measured.
    settings = [(c.data.queries, c.data.spp, c.fit) for c in found if c.study == "data" and c.data.spp == 4]
    others = [c for c in found if c.study == "seeds"]
    for setting in settings:
        assert {c.data.seed for c in others if (c.data.queries, c.data.spp, c.fit) == setting} == {1, 2, 3}
    assert len(others) == 3 * len(settings) == 6
    assert all(c.data.seed == 0 for c in found if c.study != "seeds")


def test_chains_of_other_seeds_have_other_data_and_other_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import mbtf_fit
    import mbtf_pipeline.cost_study.runs as module

    seeds: list[int] = []
    shop = module.RunRunner(GeneratorConfig(material="m", seed=5), tmp_path, "mbtf-gen m", lambda note: None)
    monkeypatch.setattr(shop, "judges", lambda: None)
    monkeypatch.setattr(module, "generate", lambda config, folder, job: seeds.append(config.seed))
    monkeypatch.setattr(module, "_quiet_job", lambda config: None)

    def fit(config: Any, shards: Path, out: Path) -> None:
        seeds.append(config.seed)
        raise KeyboardInterrupt

    monkeypatch.setattr(mbtf_fit, "fit", fit)
    options = {"training": {"time": "5s"}}
    for seed in (0, 2, 2):
        with pytest.raises(KeyboardInterrupt):
            shop.measure(module.Chain("seeds", "", "", RunRequest(64, 4, seed), options))
    # Data of one seed are made once.
    assert seeds == [5, 5, 7, 7, 7]
    assert shop.has(RunRequest(64, 4, 2))
    assert not shop.has(RunRequest(64, 4, 1))
    chain = module.Chain("seeds", "", "", RunRequest(64, 4, 2), options)
    assert shop.command_of(chain).count(" --set seed=7") == 2
    plain = module.RunRunner(GeneratorConfig(material="m"), tmp_path, "mbtf-gen m", lambda note: None)
    assert "seed" not in plain.command_of(replace(chain, data=RunRequest(64, 4)))
    assert plain.command_of(chain).count(" --set seed=2") == 2
    assert chain.key != replace(chain, data=RunRequest(64, 4)).key


class Clock:
    """Time that passes where a test lets it."""

    now = 0.0

    def perf_counter(self) -> float:
        return self.now


def test_a_chain_counts_what_it_took_and_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seven seconds of generating, five of training and one of loading; half a second to evaluate 2¹⁸
    queries; a constant, 0.1 and its nearest half-precision number, for values of 0 and 1."""
    import torch
    from mbtf_pipeline.cost_study.importance_sampled import Judges

    import mbtf_pipeline.cost_study.runs as module
    from mbtf_fit.data.queries import ShardQueries

    clock = Clock()
    n = 1000
    value = np.repeat(np.arange(n) % 2.0, 3).reshape(n, 3).astype(np.float32)
    zero = np.zeros((n, 3), np.float32)
    queries = ShardQueries(zero[:, :2], zero[:, 0], zero, zero, value, value)

    class Answer(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.answer = torch.nn.Parameter(torch.tensor([0.1]))

    class Material:
        def __init__(self) -> None:
            self.model = Answer()

        def predict(self, queries: Any) -> Any:
            return np.full((len(queries), 3), self.model.answer.detach().numpy(), np.float32)

        def evaluate(self, u: Any, *_: Any) -> None:
            assert len(u) == 1 << 18
            clock.now += 0.5

    def generate(config: GeneratorConfig, folder: Path, job: Any = None) -> None:
        clock.now += 7.0

    def fit(config: Any, shards: Path, out: Path) -> Any:
        out.mkdir(parents=True)
        (out / "weights.safetensors").write_bytes(bytes(100))
        return SimpleNamespace(material=Material(), seconds=5.0, total_seconds=6.0)

    monkeypatch.setattr(module, "generate", generate)
    monkeypatch.setattr(module, "time", clock)
    monkeypatch.setattr("mbtf_fit.fit", fit)
    shop = module.RunRunner(GeneratorConfig(material="m"), tmp_path, "mbtf-gen m", lambda note: None)
    shop._judges = Judges(queries, np.ones(n))
    options = {"training": {"time": "5s"}}
    spent = {"chain": 13.0, "data": 7.0, "seeds": 7.0, "fit": 5.0}
    for study, seconds in spent.items():
        point = shop.measure(module.Chain(study, "", "", RunRequest(640, 4), options))
        assert point.seconds.value == seconds
    found = point.details
    assert (found["generation_seconds"], found["training_seconds"], found["total_seconds"]) == (7, 5, 13)
    assert (found["queries"], found["spp"]) == (640, 4)
    assert found["evaluation_ms_1080p"] == pytest.approx(500 * 1920 * 1080 / 2**18)
    assert (found["bytes"], found["half_bytes"]) == (100, 98)
    # Mean squares of 0.1 and 0.9 over the variance of a quarter.
    for left, answer in ((point.error.value, 0.1), (found["half_error"], float(np.float16(0.1)))):
        variance = 0.25 * n / (n - 1)
        assert left == pytest.approx((answer**2 + (1 - answer) ** 2) / 2 / variance, rel=1e-5)


def test_chains_are_judged_by_as_many_paths_as_the_test_split(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import mbtf_pipeline.cost_study.runs as module

    asked: list[int] = []
    job = SimpleNamespace(material=None, lattice=SimpleNamespace(texels=lambda: 256))
    monkeypatch.setattr(module, "_quiet_job", lambda config: job)

    def draw(bench: Any, paths: int) -> str:
        asked.append(paths)
        return "judges"

    monkeypatch.setattr("mbtf_pipeline.cost_study.importance_sampled.draw_judges", draw)
    queries = {"test": "2/texel", "test_spp": 6}
    config = GeneratorConfig.model_validate({"material": "m", "queries": queries})
    shop = module.RunRunner(config, tmp_path, "mbtf-gen m", lambda note: None)
    assert shop.judges() == shop.judges()
    assert asked == [2 * 256 * 6]


def test_queries_cost_what_they_cost_on_disk(tmp_path: Path) -> None:
    """Tracing takes 0.4 µs a query, drawing and writing 0.6 µs more, and starting two seconds."""
    from mbtf_pipeline.cost_study.study import _beyond_tracing

    made: list[int] = []

    class Shop:
        config = GeneratorConfig(material="heights.npy")

        def data(self, wanted: RunRequest) -> Any:
            made.append(wanted.queries)
            return SimpleNamespace(seconds=2.0 + wanted.queries * 1e-6)

        def forget(self, wanted: RunRequest) -> None:
            assert wanted.queries == made[-1]

    store, shop = PointFolder(tmp_path, {"config": "abc"}), Shop()

    def price(spp: int) -> float:
        return 1e-7 * spp

    found = _beyond_tracing(store, shop, price)  # type: ignore[arg-type]
    assert found == pytest.approx(6e-7)
    assert len(made) == 2
    # A study that goes on has the same price, and so the same chains.
    assert _beyond_tracing(store, shop, price) == found  # type: ignore[arg-type]
    assert len(made) == 2
