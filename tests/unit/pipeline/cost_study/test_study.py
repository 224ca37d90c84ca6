"""Cost studies: what is measured is right where the answer is known, and nothing measured is lost."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mbtf_pipeline.cost_study.seed_variance import seed_scatter, with_scatter

from mbtf_core.atomic import write_json
from mbtf_core.stats import Estimate
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_pipeline.cost_study.measurements import Point, PointFolder
from mbtf_pipeline.cost_study.page import half_widths, paths_slope
from mbtf_pipeline.cost_study.pareto import marginal_price, pareto_front
from mbtf_pipeline.cost_study.tables import COLUMNS, to_csv


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


def test_csv_holds_every_number_with_its_error() -> None:
    rows = list(csv.DictReader(io.StringIO(to_csv([point(10, 0.5, bytes=3e5), point(20, math.nan)]))))
    assert tuple(rows[0]) == COLUMNS
    assert (rows[0]["seconds"], rows[0]["error"], rows[0]["error_se"]) == ("10", "0.5", "0.01")
    assert rows[0]["bytes"] == "300000"
    assert rows[0]["bias"] == rows[1]["error"] == ""


def chain(error: float, queries: int, study: str = "data", **more: Any) -> Point:
    """A chain's point."""
    five = Estimate(5.0, 0.0, 1)
    setting = {"queries.train": str(queries), "queries.spp": 4, "training.time": "5s"}
    return Point(study, "neumip", "a chain", setting | more, "", five, Estimate(error, 0.01, 9))


@pytest.mark.parametrize("n", [3, 4, 9])
def test_deviations_of_few_values_are_right_on_average(n: int) -> None:
    from mbtf_pipeline.cost_study.seed_variance import _deviation

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
    from mbtf_core.errors import InputError
    from mbtf_pipeline.cost_study.study import claim

    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(InputError, match="holds no cost study"):
        claim(tmp_path)


def test_seconds_of_two_machines_are_not_mixed(tmp_path: Path) -> None:
    from mbtf_core.errors import InputError
    from mbtf_pipeline.cost_study import study
    from mbtf_pipeline.run_folder import machine

    claim_here = study.claim
    claim_here(tmp_path / "new")
    known = {"format": study.STUDY_FORMAT, "machine": machine()}
    write_json(tmp_path / "new" / study.STUDY_NAME, known)
    claim_here(tmp_path / "new")
    known["machine"] = {"system": "Plan 9, 64 processors"}
    write_json(tmp_path / "new" / study.STUDY_NAME, known)
    with pytest.raises(InputError, match=r"another kind of machine .Plan 9, 64 processors; this is "):
        claim_here(tmp_path / "new")


def test_studies_count_paths_whatever_the_recipe_aims_at() -> None:
    """With a target error all numbers of paths would be one setting; and fits learn from single queries."""
    from mbtf_pipeline.cost_study.study import studied

    queries = {"target_error": "5%", "layout": "image", "patch_size": 8, "spp": 6}
    config = GeneratorConfig.model_validate({"material": "m", "seed": 3, "queries": queries})
    found = studied(config, None)
    assert found.queries.target_error is None
    assert (found.queries.layout, found.queries.spp, found.seed) == ("shuffled", 6, 3)
    assert studied(config, 7).seed == 7
    # A recipe without either is studied as it stands, and so finds the points that were measured of it.
    plain = GeneratorConfig(material="m")
    assert studied(plain, None) == plain
