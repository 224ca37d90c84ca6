"""Cost studies: what is measured is right where the answer is known, and nothing measured is lost."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mbtf_gen.config import GeneratorConfig
from mbtf_gen.estimates import Estimates, Stream
from mbtf_gen.generation import Job
from mbtf_gen.material import Material
from mbtf_gen.queries import Queries
from mbtf_gen.stats import Estimate
from mbtf_pipeline.cost.chain_studies import DATA, FIT, GENERATOR, SHORTEST, WHOLE, chains
from mbtf_pipeline.cost.front import marginal_price, pareto_front
from mbtf_pipeline.cost.generator import Bench
from mbtf_pipeline.cost.points import Point, PointFolder
from mbtf_pipeline.cost.tables import COLUMNS, to_csv

NOISE = 0.8  # standard deviation of one path, relative to the value
SHIFT = 0.25  # bias of a run with one interaction, relative to the value


class Fake:
    """Values of known bias and noise; random numbers by the stream alone, as the real ones."""

    def __init__(self, job: Job) -> None:
        self.shift = SHIFT if job.config.transport.max_depth == 1 else 0.0

    def estimate(self, queries: Queries, spp: int, stream: Stream) -> Estimates:
        # Other paths have other noise, as where another setting takes other turns.
        rng = np.random.default_rng([stream.root, stream.shard, len(queries.sigma), self.shift > 0])
        truth = 0.2 + 0.1 * queries.u[:, :1]
        # The bias has either sign: what counts is its square, query by query.
        sign = np.where(queries.u[:, 1:] < 0.5, -1.0, 1.0)
        halves = [
            truth * (1 + self.shift * sign)
            + 0.25 * NOISE * rng.normal(size=(len(truth), 3)) / math.sqrt(spp / 2)
            for _ in range(2)
        ]
        a, b = (h.astype(np.float32) for h in halves)
        return Estimates(a, b, None, len(truth) * spp, 0, 0, 0)


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    monkeypatch.setattr(Job, "estimator", lambda self, plan: Fake(self))
    monkeypatch.setattr("mbtf_pipeline.cost.generator.plan_effects", lambda job: None)
    heights = np.random.default_rng(0).random((8, 8))
    material = Material(heights, height_scale=0.1, height_bits=None, basecolor=np.array([0.5, 0.5, 0.5]))
    return Bench(GeneratorConfig(material="heights.npy"), material, 0)


@pytest.mark.parametrize("spp", [4, 64])
def test_bias_and_noise_are_told_apart(bench: Bench, spp: int) -> None:
    found = bench.measure({"transport.max_depth": 1, "queries.spp": spp}, {}, 0.0)
    # Relative to the mean value 0.25: the bias is the shift times the values, the noise that of spp paths.
    bias = SHIFT * math.sqrt(np.mean((0.2 + 0.1 * np.linspace(0, 1, 10001)) ** 2)) / 0.25
    noise = NOISE / math.sqrt(spp)
    assert found.bias is not None
    for estimate, truth in ((found.bias, bias), (found.noise, noise), (found.error, math.hypot(bias, noise))):
        assert abs(estimate.value - truth) < 4 * estimate.error
        assert estimate.error < 0.05 * truth
    assert found.seconds.value > 0


def test_an_unbiased_setting_shows_no_bias(bench: Bench) -> None:
    found = bench.measure({"transport.max_depth": 3}, {}, 0.0)
    assert found.bias is not None
    assert found.bias.value == 0.0
    assert bench.measure({"queries.spp": 8}, None, 0.0).bias is None


def test_seeds_change_the_measurement_and_nothing_else_does(bench: Bench) -> None:
    again = Bench(bench.config, bench.material, 0)
    other = Bench(bench.config, bench.material, 1)
    noise = [b.measure({"queries.spp": 8}, None, 0.0).noise for b in (bench, again, other)]
    assert noise[0] == noise[1]
    assert noise[0].value != noise[2].value
    assert abs(noise[0].value - noise[2].value) < 4 * math.hypot(noise[0].error, noise[2].error)


def point(seconds: float, error: float, study: str = "chain", **details: float) -> Point:
    return Point(
        study,
        "s",
        f"{seconds:g}",
        {},
        "command",
        Estimate(seconds, 0.0, 1),
        Estimate(error, 0.01, 9),
        details=details,
    )


def test_front_holds_what_nothing_beats() -> None:
    points = [
        point(10, 0.5),
        point(20, 0.6),
        point(20, 0.4),
        point(40, 0.4),
        point(80, 0.1),
        point(5, math.nan),
    ]
    assert [(p.seconds.value, p.error.value) for p in pareto_front(points)] == [
        (10, 0.5),
        (20, 0.4),
        (80, 0.1),
    ]


def test_price_of_half_the_error_follows_a_power_law() -> None:
    front = [point(t, 2.0 * t**-0.5) for t in (10.0, 20.0, 40.0, 80.0)]
    price = marginal_price(front)
    assert price is not None
    # At a power of one half, half the error takes four times as long: three times as much more.
    assert price[0] == pytest.approx(3 * 80.0)
    assert price[1] == pytest.approx(0.5)
    assert marginal_price(front[:2]) is None


def test_points_come_back_and_damaged_ones_are_measured_again(tmp_path: Path) -> None:
    store = PointFolder(tmp_path, {"config": "abc"})
    kept = Point(
        "mesh", "mesh", "64 cells", {"geometry.mesh": 64}, "mbtf-gen …", Estimate(1.5, 0.1, 7),
        Estimate(0.2, 0.01, 100), Estimate(0.1, math.inf, 100), None, {"bytes": 12.0},
    )  # fmt: skip
    store.put({"changes": 1}, kept)
    assert store.get("mesh", {"changes": 1}) == kept
    assert store.get("mesh", {"changes": 2}) is None
    assert store.get("light", {"changes": 1}) is None
    assert PointFolder(tmp_path, {"config": "abd"}).get("mesh", {"changes": 1}) is None
    (path,) = store.folder.iterdir()
    path.write_text(path.read_text()[:-20])
    assert store.get("mesh", {"changes": 1}) is None


def test_csv_holds_every_number_with_its_error() -> None:
    rows = list(csv.DictReader(io.StringIO(to_csv([point(10, 0.5, bytes=3e5), point(20, math.nan)]))))
    assert tuple(rows[0]) == COLUMNS
    assert (rows[0]["seconds"], rows[0]["error"], rows[0]["error_se"]) == ("10", "0.5", "0.01")
    assert rows[0]["bytes"] == "300000"
    assert rows[0]["bias"] == rows[1]["error"] == ""


@pytest.mark.parametrize("budget", [600.0, 3600.0])
def test_chains_fit_into_their_budget(budget: float) -> None:
    def price(spp: int) -> float:
        return spp * 5e-7

    found = list(chains(budget, 4, price))
    assert {c.study for c in found} == {"chain", "data", "fit"}
    made: set[tuple[int, int]] = set()
    spent = dict.fromkeys(("data", "fit", "chain"), 0.0)
    for chain in found:
        spent[chain.study] += chain.seconds(price, data=(chain.queries, chain.spp) not in made)
        made.add((chain.queries, chain.spp))
    assert 0.4 * budget < sum(spent.values()) < (1.0 - GENERATOR) * budget
    for study, share in (("data", DATA), ("fit", FIT), ("chain", WHOLE)):
        assert spent[study] <= 1.05 * share * budget
    # Equal numbers of paths are compared, whatever their number per query.
    budgets = {c.queries * c.spp for c in found if c.study == "data"}
    assert len(budgets) == 2
    whole = [c for c in found if c.study == "chain"]
    assert min(c.seconds(price) for c in whole) == pytest.approx(SHORTEST, rel=0.1)


def test_a_study_of_a_folder_with_something_else_in_it_is_refused(tmp_path: Path) -> None:
    from mbtf_gen.errors import InputError
    from mbtf_pipeline.cost.study import claim

    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(InputError, match="holds no cost study"):
        claim(tmp_path)


def test_plots_name_their_axes_and_bars(tmp_path: Path) -> None:
    from mbtf_pipeline.plots import Cloud, scatter

    cloud: Any = Cloud("series", [1.0, 10.0], [0.5, 0.1], [0.1, 0.0], [0.02, 0.5], ["first", "second"])
    svg = scatter([cloud], "seconds", "error", "a plot", front=[(1.0, 0.5)], png=tmp_path / "a.png")
    for text in ("seconds", "error", "series", "first", "second", "front"):
        assert text in svg
    assert (tmp_path / "a.png").read_bytes()[:4] == b"\x89PNG"
