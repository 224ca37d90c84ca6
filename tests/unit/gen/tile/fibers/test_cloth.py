"""Cloth as a material: its file, its options, its place in a job."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.paths import ASSETS

from mbtf_core.errors import InputError
from mbtf_gen.tile.cloth import loose_ends
from mbtf_gen.tile.fiber_tile import FiberTile, absorption
from mbtf_gen.tile.fibers.curves import Bundle, Curve
from mbtf_gen.tile.loading import load_material

# Sum of all control points and radii of the basket weave.
GOLDEN = 31350.997477935016

WEAVE = "weave: plain\nyarn: {type: silk1, fibers: 3}\n"


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "cloth.yaml"
    path.write_text(text)
    return path


def fibers(tmp_path: Path, text: str) -> Any:
    return load_material(write(tmp_path, text))


def test_a_weave_has_the_yarns_of_its_draft(tmp_path: Path) -> None:
    found = fibers(
        tmp_path,
        "weave: |\n  X..\n  .X.\nyarn: {fibers: 5, flyaways: 0}\n"
        "yarns: {a: {}, b: {color: 0.2}}\nwarp: a\nweft: b\n",
    )
    assert found.aspect == pytest.approx(2 / 3)
    # Four plies of five fibers in three warps and two wefts.
    assert len(found.curves) == 4 * 5 * 5
    assert np.bincount(found.yarn).tolist() == [60, 40]
    assert found.colors[1].tolist() == [0.2, 0.2, 0.2]
    assert Bundle(found.curves).heights()[1] == pytest.approx(0.0, abs=1e-12)
    repeated = fibers(tmp_path, "weave: plain\nrepeat: 3\nyarn: {fibers: 2, flyaways: 0}\n")
    assert len(repeated.curves) == 12 * 4 * 2


def test_every_option_changes_the_digest(tmp_path: Path) -> None:
    keys = "color 0.1,width 0.5,height 0.9,flyaways 2,radius 2,roughness 0.5,azimuthal_roughness 0.5"
    yarn = [
        WEAVE.replace("}", f", {k.replace(' ', ': ')}}}") for k in f"{keys},scale_tilt 1,ior 1.4".split(",")
    ]
    other = [WEAVE.replace(*p) for p in (("plain", "basket 2"), ("silk1", "silk2"), ("s: 3", "s: 4"))]
    yarns = "yarns: {a: 0.5, b: '#808080'}\nwarp: a b\n"
    more = ("repeat: 2\n", "seed: 1\n", "resolution: 64\n", yarns, yarns + "weft: a\n")
    texts = [WEAVE, *yarn, *other, *(WEAVE + text for text in more)]
    digests = {str(load_material(write(tmp_path, text)).digests) for text in texts}
    assert len(digests) == len(texts)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("weave: plain\nknit: {}\n", "one of"),
        ("knit: {}\nrepeat: 2\n", "goes with"),
        ("pattern: missing.pyp\n", "no such file"),
        ("weave: basket 64\nrepeat: 64\n", "crossings"),
        ("weave: basket 9\nyarn: {fibers: 90000}\n", "segments"),
        ("weave: plain\nyarn: {width: 1000000}\n", "periods"),
        ("weave: plain\nyarn: {radius: 0.001, fibers: 2}\n", "thinner"),
        ("weave: |\n" + "  X\n" * 100, "times as long"),
        ("weave: plain\nyarns: {a: 1}\n", "sequence"),
        ("weave: plain\nyarns: {red: 1, rest: 0}\nwarp: red\n", "'rest' is in neither"),
        ("weave: plain\nyarns: {red: 1}\nwarp: rde4\n", "did you mean 'red'"),
        ("weave: houndstooth\n", "two yarns"),
        ("seed: 1\nweave: twil 3/1\n", "yaml:2: weave: 'twil 3/1' is not a weave\n  did you mean 'twill'?"),
        ("weave: twill 3/1\nyarns: {a: 1, b: 0}\nwarp: a601 b\nweft: a499 b\n", "1204 warps"),
        ("curves: a.curves\nseed: 2\n", "seed"),
    ],
)
def test_faults_are_one_line(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(InputError) as error:
        load_material(write(tmp_path, text))
    assert says in f"{error.value} {error.value.hint}"
    assert "\n" not in error.value.what


def test_yarns_keep_what_they_do_not_give_themselves(tmp_path: Path) -> None:
    text = (
        "weave: denim\nyarn: {type: silk1, roughness: 0.5, fibers: 3, flyaways: 0, ior: 1.4}\n"
        "yarns: {blue: '#0000ff', ecru: {color: [0.7, 0.6, 0.5], roughness: 0.2, fibers: 7, radius: 2}}\n"
    )
    found = fibers(tmp_path, text)
    assert found.names == ("blue", "ecru")
    assert found.colors == pytest.approx(np.array([[0.0, 0.0, 1.0], [0.7, 0.6, 0.5]]))
    parameters = [(s.roughness, s.azimuthal_roughness, s.ior) for s in found.scattering]
    assert parameters == [(0.5, 0.41, 1.4), (0.2, 0.41, 1.4)]
    # Four warps of four plies of three fibers, four wefts of seven, which are twice as thick.
    assert np.bincount(found.yarn).tolist() == [48, 112]
    thin, thick = (
        {float(found.curves[k].control[0, 3]) for k in np.flatnonzero(found.yarn == y)} for y in (0, 1)
    )
    assert max(thick) == pytest.approx(2.0 * max(thin))


def test_sequences_begin_at_the_left_and_at_the_top(tmp_path: Path) -> None:
    text = "weave: plain\nyarn: {fibers: 1, flyaways: 0}\nyarns: {a: 1, b: 0, c: 1, d: 0}\n"
    found = fibers(tmp_path, text + "warp: a b3\nweft: c d3\n")
    middle = np.array([curve.control[:, :2].mean(axis=0) for curve in found.curves])
    assert middle[found.yarn == 0, 0].mean() == pytest.approx(1 / 8, abs=0.02)
    assert middle[found.yarn == 2, 1].mean() == pytest.approx(7 / 8, abs=0.02)


def test_white_absorbs_nothing_and_darker_colors_more() -> None:
    color = np.array([1.0, 0.9, 0.5, 0.1, 0.0])
    found = absorption(color, 0.3)
    assert found[0] == 0.0
    assert (np.diff(found) > 0).all()
    # Chiang et al. 2016, equation 9, at β_N = 0.3: the polynomial is 5.888.
    assert found[2] == pytest.approx((np.log(0.5) / 5.888) ** 2, rel=1e-3)


def test_ends_beside_the_corner_have_partners() -> None:
    """The remainder of -1e-17 by a period is the period."""
    x = np.arange(-1, 6)[:, None] / 4
    curves = [Curve(x * [1.0, 0, 0, 0] + [0.0, y, 0.0, 0.01]) for y in (-1e-17, 0.5)]
    assert loose_ends(FiberTile(1.0, curves, np.zeros(2, int), np.ones((1, 3)))) == 0


@pytest.mark.parametrize(("yarn", "factor"), [("", 1.0), ("yarn: {radius: 3}\n", 3.0)])
def test_radii_of_files_are_divided_by_the_width_of_the_period(
    tmp_path: Path, yarn: str, factor: float
) -> None:
    (tmp_path / "a.curves").write_text("".join(f"{x / 2} 1 0 .02\n" for x in range(-1, 6)))
    (curve,) = load_material(write(tmp_path, f"curves: a.curves\nperiod: [2, 1]\n{yarn}")).curves
    assert curve.control[:, 3] == pytest.approx(factor * 0.01)


def test_a_changed_file_is_another_data_set(tmp_path: Path) -> None:
    content = "".join(f"{x / 4} 0.5 0 .01\n" for x in range(-1, 6))
    path = write(tmp_path, "curves: fibers.txt\nperiod: [1, 1]\n")
    (tmp_path / "fibers.txt").write_text(content)
    before = load_material(path).digests
    # As many bytes as before.
    (tmp_path / "fibers.txt").write_text(content.replace("0.5 0 .01", "0.4 0 .01"))
    assert load_material(path).digests["curves"] != before["curves"]


def test_fibers_are_the_same_on_every_machine() -> None:
    """Shards of one data set may come from several."""
    found = load_material(ASSETS / "basket_weave")
    points = np.concatenate([curve.control for curve in found.curves])
    assert points.sum() == pytest.approx(GOLDEN, abs=1e-6)
