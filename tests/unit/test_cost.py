"""Cost studies: what is measured is right where the answer is known, and nothing measured is lost."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mbtf_gen.atomic import write_json
from mbtf_gen.config import GeneratorConfig
from mbtf_gen.stats import Estimate
from mbtf_pipeline.cost.chain_studies import DATA, FIT, GENERATOR, QUALITIES, SHORTEST, WHOLE, chains
from mbtf_pipeline.cost.chains import Wanted
from mbtf_pipeline.cost.figures import chain_name
from mbtf_pipeline.cost.front import marginal_price, pareto_front
from mbtf_pipeline.cost.page import half_widths, paths_slope
from mbtf_pipeline.cost.points import Point, PointFolder
from mbtf_pipeline.cost.scatter import seed_scatter, with_scatter
from mbtf_pipeline.cost.tables import COLUMNS, to_csv


def test_the_slope_of_the_noise_is_that_of_its_variance() -> None:
    one = Estimate(1.0, 0.0, 1)
    points = [
        Point("paths", "", "", {"queries.spp": n}, "", one, one, noise=Estimate(e, 0.01 * e, 9))
        for n, e in ((n, 2.0 * n**-0.6) for n in (2, 8, 32))
    ]
    slope = paths_slope(points)
    assert slope is not None
    assert slope.value == pytest.approx(-1.2)
    # All bars are alike, 2 % of the variance: that of the slope of a line.
    assert slope.error == pytest.approx(0.02 / math.sqrt(2 * math.log(4) ** 2))
    assert paths_slope(points[:2]) is None


def test_half_widths_are_those_of_95_percent() -> None:
    # All bars are 0.01: 4 % of 0.5, 20 % of 0.1.
    assert half_widths([point(1, 0.5), point(1, 0.1), point(1, 0.5, "seeds")]) == (1, 2)


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
    assert price[1].value == pytest.approx(0.5)
    assert marginal_price(front[:2]) is None


def test_the_price_of_more_is_that_of_the_front_s_end() -> None:
    """A front that starts steeply, by the square, and ends with the power of a quarter."""
    late = [(24.0, 0.115), (60.0, 0.115 * 2.5**-0.25), (120.0, 0.115 * 5**-0.25)]
    front = [point(t, 0.115 * (t / 24) ** -2) for t in (8.0, 10.0, 14.0)] + [point(*p) for p in late]
    price = marginal_price(front)
    assert price is not None
    assert price[1].value == pytest.approx(0.25)
    assert price[0] == pytest.approx(15 * 120.0)
    # What the bars do not tell from standing still is promised nothing.
    assert marginal_price([point(t, e) for t, e in ((20.0, 0.2), (40.0, 0.199), (80.0, 0.198))]) is None
    unknown = [replace(p, error=replace(p.error, error=math.inf)) for p in front]
    assert marginal_price(unknown) is None


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


def test_what_could_not_be_told_is_kept_and_shown_as_such(tmp_path: Path) -> None:
    """Test values whose variance is not told from zero leave no error."""
    from mbtf_pipeline.cost.page import write_page
    from mbtf_pipeline.cost.study import Study

    store = PointFolder(tmp_path, {})
    unknown = made("fit", 10.0, math.nan)
    store.put({"n": 1}, unknown)
    found = store.get("fit", {"n": 1})
    assert found is not None
    assert math.isnan(found.error.value)
    assert math.isnan(found.details["half_error"])
    assert found.details["bytes"] == unknown.details["bytes"]
    page = write_page(Study(tmp_path, DESCRIPTION, [found], test_seconds=90.0)).read_text()
    assert not re.search(r"\b(nan|inf)\b", page)
    assert "No unexplained variance of test queries could be told" in page
    # Chains whose scatter is not known have bars that are too narrow.
    assert "too few seeds" in page
    assert "--narrow" not in page
    assert "for about 1:30 of tracing" in page
    summary = json.loads((tmp_path / "study.json").read_text())["summary"]
    assert (summary["known_to_a_tenth"], summary["known"], summary["scatter"]) == (0, 0, None)


def test_csv_holds_every_number_with_its_error() -> None:
    rows = list(csv.DictReader(io.StringIO(to_csv([point(10, 0.5, bytes=3e5), point(20, math.nan)]))))
    assert tuple(rows[0]) == COLUMNS
    assert (rows[0]["seconds"], rows[0]["error"], rows[0]["error_se"]) == ("10", "0.5", "0.01")
    assert rows[0]["bytes"] == "300000"
    assert rows[0]["bias"] == rows[1]["error"] == ""


@pytest.mark.parametrize("budget", [600.0, 900.0, 3600.0])
def test_chains_fit_into_their_budget(budget: float) -> None:
    def price(spp: int) -> float:
        return spp * 5e-7

    found = list(chains(budget, 4, price))
    assert {c.study for c in found} == {"chain", "data", "fit", "seeds"}
    made: set[Wanted] = set()
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
    import mbtf_pipeline.cost.chains as module

    seeds: list[int] = []
    shop = module.Workshop(GeneratorConfig(material="m", seed=5), tmp_path, "mbtf-gen m", lambda note: None)
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
            shop.measure(module.Chain("seeds", "", "", Wanted(64, 4, seed), options))
    # Data of one seed are made once.
    assert seeds == [5, 5, 7, 7, 7]
    assert shop.has(Wanted(64, 4, 2))
    assert not shop.has(Wanted(64, 4, 1))
    chain = module.Chain("seeds", "", "", Wanted(64, 4, 2), options)
    assert shop.command_of(chain).count(" --set seed=7") == 2
    plain = module.Workshop(GeneratorConfig(material="m"), tmp_path, "mbtf-gen m", lambda note: None)
    assert "seed" not in plain.command_of(replace(chain, data=Wanted(64, 4)))
    assert plain.command_of(chain).count(" --set seed=2") == 2
    assert chain.key != replace(chain, data=Wanted(64, 4)).key


class Clock:
    """Time that passes where a test lets it."""

    now = 0.0

    def perf_counter(self) -> float:
        return self.now


def test_a_chain_counts_what_it_took_and_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seven seconds of generating, five of training and one of loading; half a second to evaluate 2¹⁸
    queries; a constant, 0.1 and its nearest half-precision number, for values of 0 and 1."""
    import torch

    import mbtf_pipeline.cost.chains as module
    from mbtf_fit.data import Queries
    from mbtf_pipeline.cost.judges import Judges

    clock = Clock()
    n = 1000
    value = np.repeat(np.arange(n) % 2.0, 3).reshape(n, 3).astype(np.float32)
    zero = np.zeros((n, 3), np.float32)
    queries = Queries(zero[:, :2], zero[:, 0], zero, zero, value, value)

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
    shop = module.Workshop(GeneratorConfig(material="m"), tmp_path, "mbtf-gen m", lambda note: None)
    shop._judges = Judges(queries, np.ones(n))
    options = {"training": {"time": "5s"}}
    spent = {"chain": 13.0, "data": 7.0, "seeds": 7.0, "fit": 5.0}
    for study, seconds in spent.items():
        point = shop.measure(module.Chain(study, "", "", Wanted(640, 4), options))
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
    import mbtf_pipeline.cost.chains as module

    asked: list[int] = []
    job = SimpleNamespace(material=None, lattice=SimpleNamespace(texels=lambda: 256))
    monkeypatch.setattr(module, "_quiet_job", lambda config: job)

    def draw(bench: Any, paths: int) -> str:
        asked.append(paths)
        return "judges"

    monkeypatch.setattr("mbtf_pipeline.cost.judges.draw_judges", draw)
    queries = {"test": "2/texel", "test_spp": 6}
    config = GeneratorConfig.model_validate({"material": "m", "queries": queries})
    shop = module.Workshop(config, tmp_path, "mbtf-gen m", lambda note: None)
    assert shop.judges() == shop.judges()
    assert asked == [2 * 256 * 6]


def test_queries_cost_what_they_cost_on_disk(tmp_path: Path) -> None:
    """Tracing takes 0.4 µs a query, drawing and writing 0.6 µs more, and starting two seconds."""
    from mbtf_pipeline.cost.study import _beyond_tracing

    made: list[int] = []

    class Shop:
        config = GeneratorConfig(material="heights.npy")

        def data(self, wanted: Wanted) -> Any:
            made.append(wanted.queries)
            return SimpleNamespace(seconds=2.0 + wanted.queries * 1e-6)

        def forget(self, wanted: Wanted) -> None:
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


def chain(error: float, queries: int, study: str = "data", **more: Any) -> Point:
    """A chain's point."""
    five = Estimate(5.0, 0.0, 1)
    setting = {"queries.train": str(queries), "queries.spp": 4, "training.time": "5s"}
    return Point(study, "neumip", "a chain", setting | more, "", five, Estimate(error, 0.01, 9))


@pytest.mark.parametrize("n", [3, 4, 9])
def test_deviations_of_few_values_are_right_on_average(n: int) -> None:
    from mbtf_pipeline.cost.scatter import _deviation

    samples = np.random.default_rng(0).normal(size=(4000, n))
    found = [_deviation(list(row)) for row in samples]
    values = np.array([e.value for e in found])
    assert abs(values.mean() - 1) < 4 * values.std() / math.sqrt(len(values))
    # The bar is that of large samples, about.
    assert 0.8 < np.mean([e.error for e in found]) / values.std() < 1.3


def test_bars_of_chains_hold_the_scatter_of_seeds() -> None:
    few, many = (0.22, 0.18, 0.21), (0.101, 0.099, 0.1)
    points = [chain(0.2, 100), chain(0.1, 1600), chain(0.4, 400, "chain"), point(8, 0.3, "paths")]
    seeds = [
        chain(e, queries, "seeds", seed=n)
        for queries, errors in ((100, few), (1600, many))
        for n, e in enumerate(errors, start=1)
    ]
    scatter = seed_scatter([*points, *seeds])
    assert scatter is not None
    assert (scatter.spp, scatter.queries) == (4, (100, 1600))
    # A sample's deviation is low by 8 % on average for four values.
    deviations = [np.std(np.log(errors), ddof=1) / 0.9213 for errors in ((0.2, *few), (0.1, *many))]
    assert [e.value for e in scatter.deviations] == pytest.approx(deviations, rel=1e-4)
    # Half-way in the logarithm of the size, and no further than at its ends.
    middle = np.mean(deviations)
    assert scatter.of(points[2]) == pytest.approx(middle, rel=1e-4)
    ends = [scatter.of(chain(0.3, n)) for n in (1, 10**8)]
    assert ends == pytest.approx(deviations, rel=1e-4)
    # Half of the paths per query are half of the data; twice as many for half as many queries are so too.
    other = [chain(0.3, n, **{"queries.spp": spp}) for n, spp in ((800, 2), (400, 8))]
    assert [scatter.of(p) for p in other] == pytest.approx([middle, middle], rel=1e-4)
    assert scatter.describe().endswith("% at 0.0016 M queries × 4")
    widened = with_scatter([*points, *seeds], scatter)
    assert widened[2].error.error == pytest.approx(math.hypot(0.01, 0.4 * middle), rel=1e-4)
    # The generator's errors are not those of fits.
    assert widened[3] == points[3]
    # Another setting's error is no part of it, and two values are too few to tell.
    other = [chain(9.0, 100, **{"training.time": "9s"}), chain(9.0, 100, "fit")]
    assert seed_scatter([*points, *seeds, *other]) == scatter
    assert seed_scatter([points[0], seeds[0]]) is None
    assert with_scatter([points[0], seeds[0]], None) == [points[0], seeds[0]]


def test_a_study_of_a_folder_with_something_else_in_it_is_refused(tmp_path: Path) -> None:
    from mbtf_gen.errors import InputError
    from mbtf_pipeline.cost.study import claim

    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(InputError, match="holds no cost study"):
        claim(tmp_path)


def test_seconds_of_two_machines_are_not_mixed(tmp_path: Path) -> None:
    from mbtf_gen.errors import InputError
    from mbtf_pipeline.cost import study
    from mbtf_pipeline.run_folder import machine

    claim_here = study._claim_for_this_machine
    claim_here(tmp_path / "new")
    known = {"format": study.STUDY_FORMAT, "machine": machine()}
    write_json(tmp_path / "new" / study.STUDY_NAME, known)
    claim_here(tmp_path / "new")
    known["machine"] = {"system": "Plan 9, 64 processors"}
    write_json(tmp_path / "new" / study.STUDY_NAME, known)
    with pytest.raises(InputError, match=r"another machine .Plan 9, 64 processors; this is "):
        claim_here(tmp_path / "new")


def test_studies_count_paths_whatever_the_recipe_aims_at() -> None:
    """With a target error all numbers of paths would be one setting; and fits learn from single queries."""
    from mbtf_pipeline.cost.study import studied

    queries = {"target_error": "5%", "layout": "image", "window": 8, "spp": 6}
    config = GeneratorConfig.model_validate({"material": "m", "seed": 3, "queries": queries})
    found = studied(config, None)
    assert found.queries.target_error is None
    assert (found.queries.layout, found.queries.spp, found.seed) == ("shuffled", 6, 3)
    assert studied(config, 7).seed == 7
    # A recipe without either is studied as it stands, and so finds the points that were measured of it.
    plain = GeneratorConfig(material="m")
    assert studied(plain, None) == plain


def test_plots_name_their_axes_and_bars(tmp_path: Path) -> None:
    from mbtf_pipeline.plots import Cloud, scatter

    cloud: Any = Cloud("series", [1.0, 10.0], [0.5, 0.1], [0.1, 0.0], [0.02, 0.5], ["first", "second"])
    svg = scatter([cloud], "seconds", "error", "a plot", front=[(1.0, 0.5)], png=tmp_path / "a.png")
    for text in ("seconds", "error", "series", "first", "second", "front"):
        assert text in svg
    with Image.open(tmp_path / "a.png") as picture:
        # On white, whatever lies behind it.
        assert picture.convert("RGBA").getpixel((1, 1)) == (255, 255, 255, 255)


def test_a_legend_of_long_names_is_no_wider_than_the_figure() -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from mbtf_pipeline.plots import _legend_above

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot()
    _legend_above(figure, [(axes.plot([0])[0], f"a name of some length, number {n}") for n in range(6)])
    (legend,) = figure.legends
    extent = legend.get_window_extent(FigureCanvasAgg(figure).get_renderer())
    assert extent.width <= figure.bbox.width
    assert len(legend.get_texts()) == 6


def test_every_line_of_a_study_has_a_colour_and_a_mark_of_its_own() -> None:
    from mbtf_pipeline.cost.chain_studies import MODELS, SIZES
    from mbtf_pipeline.plots import COLOURS, MARKERS

    assert 1 + len(MODELS) + len(SIZES) <= len(set(COLOURS)) == len(set(MARKERS)) == len(COLOURS)


def test_names_lie_on_no_point_and_on_no_other_name() -> None:
    """Points of a cluster, close enough that names beside them would cover each other."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from mbtf_pipeline.labels import Named, place_names

    figure = Figure(figsize=(7, 4))
    axes = figure.add_subplot()
    spots = [(0.5, 0.5), (0.52, 0.5), (0.54, 0.51), (0.95, 0.5)]
    axes.set(xlim=(0, 1), ylim=(0, 1))
    line = ((0.4, 0.5), (0.6, 0.5))
    place_names(figure, axes, [Named(*s, "a name of some length", "k") for s in spots], spots, [line])
    renderer = FigureCanvasAgg(figure).get_renderer()
    boxes = [t.get_window_extent(renderer) for t in axes.texts]
    assert len(boxes) == len(spots)
    for number, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:number])
        assert not any(box.contains(*axes.transData.transform(s)) for s in spots)
        # Letters at another resolution may be wider.
        assert box.x1 <= axes.get_window_extent(renderer).x1 - 0.02 * box.width
        ends = [axes.transData.transform(end) for end in line]
        across = box.x0 < ends[1][0] and box.x1 > ends[0][0]
        assert not (across and box.y0 < ends[0][1] < box.y1)


DESCRIPTION = {
    "name": "a study", "machine": {"system": "a machine"}, "made": "today", "budget": 600.0,
    "material": "rock", "command": "mbtf-pipeline cost rock",
}  # fmt: skip


def made(study: str, seconds: float, error: float, series: str = "neumip", **details: float) -> Point:
    """A chain's point as the workshop makes it."""
    numbers = {
        "queries": 1e6, "spp": 4.0, "generation_seconds": 3.0, "training_seconds": seconds,
        "total_seconds": seconds + 4.0, "evaluation_ms_1080p": 250.0, "bytes": 1e6, "half_bytes": 5e5,
        "half_error": error * 1.01, "half_error_se": 0.01,
    }  # fmt: skip
    spent, left = Estimate(seconds, 0.0, 1), Estimate(error, 0.01, 9)
    return Point(
        study, series, f"{seconds:g} s", {}, "mbtf-gen a && mbtf-fit b", spent, left, details=numbers
    )


def test_the_page_shows_the_front_with_commands_and_what_is_biased(tmp_path: Path) -> None:
    from mbtf_pipeline.cost.page import write_page
    from mbtf_pipeline.cost.study import Study

    def setting(name: str, bias: Estimate) -> Point:
        second, noise = Estimate(1.0, 0.1, 4), Estimate(0.5, 0.01, 9)
        return Point("bounces", "interactions", name, {}, "mbtf-gen c", second, noise, bias, noise)

    points = [
        made("fit", 10.0, 0.3), made("fit", 20.0, 0.2), made("fit", 20.0, 0.4, "neumip-baseline"),
        setting("1 interactions", Estimate(0.05, 0.004, 9)),
        setting("2 interactions", Estimate(0.002, 0.003, 9)), setting("no limit", Estimate(0.0, 0.0, 9)),
    ]  # fmt: skip
    page = write_page(Study(tmp_path, DESCRIPTION, points)).read_text()
    names = {p.stem for p in tmp_path.glob("*.png")}
    assert names == {"front", "fit", "fit_evaluation", "fit_bytes", "bounces"}
    front = page.split('id="front"')[1].split("</section>")[0]
    # Two of the three chains, in sight, each with a command that one click selects.
    assert front.count("<td class=command><code>mbtf-gen a &amp;&amp; mbtf-fit b</code></td>") == 2
    assert "<details>" not in front
    bounces = page.split('id="bounces"')[1].split("</section>")[0]
    # The bias that is told from zero has a bar, the other a limit, and what is the reference's own has none.
    assert "<td>5.0 ± 0.4 %</td>" in bounces
    assert "<td>&lt; 0.6 %</td>" in bounces
    assert "<td>0 %</td>" in bounces
    assert "at most 0.6 % of the mean value" in bounces
    assert not re.search(r"\bnan\b", page)


def test_chains_on_the_front_are_told_apart() -> None:
    five, error = Estimate(5.0, 0.0, 1), Estimate(0.2, 0.01, 9)

    def name(study: str, series: str) -> str:
        details = {"queries": 1.1e7, "spp": 4.0}
        return chain_name(Point(study, series, "17.8 s", {}, "", five, error, details=details))

    assert name("fit", QUALITIES) == name("data", "4 paths/query") == "11 M × 4"
    assert name("fit", "neumip") == "11 M × 4, neumip of its paper"
    assert name("fit", "neumip, 40 wide, 12 channels, z") == "11 M × 4, 40 wide, 12 channels, z"
