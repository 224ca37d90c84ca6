"""The recipe makes the same data again, and states its digests; maps are copied whole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.formula_runs import SMALL, Formula, cheap_plan
from support.published import contents

from mbtf_core.config.settings import resolve
from mbtf_core.data.dataset import Dataset
from mbtf_core.errors import InputError, UsageError
from mbtf_core.files.atomic import file_sha256
from mbtf_gen.config.exchange import PublishConfig
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation import run as generation
from mbtf_gen.publishing.publication import Publication

CONFIG = PublishConfig(license="CC0-1.0", form="npz")


@pytest.fixture
def engine(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = Formula()
    monkeypatch.setattr(generation, "plan_run", cheap_plan)
    monkeypatch.setattr(generation, "build_estimator", lambda job, plan: fake)


def write_maps(folder: Path) -> Path:
    """A material whose maps lie in several folders under the same names, with options."""
    random = np.random.default_rng(1)
    for name in ("a", "b"):
        (folder / name).mkdir(parents=True)
    np.save(folder / "a/map.npy", 0.1 * random.random((4, 8)))
    np.save(folder / "b/map.npy", random.random((4, 8)))
    Image.fromarray(random.integers(0, 255, (4, 8, 3), np.uint8)).save(folder / "color.png")
    (folder / "material.yaml").write_text(
        "height: {file: a/map.npy, scale: 0.5}\nroughness: {file: b/map.npy, invert: true}\n"
        "base_color: color.png\nmetallic: 0.25\nmake_tileable: mirror\nresolution: 8\n"
    )
    return folder


def remade(card: Path, output: Path, material: Path | None = None) -> Dataset:
    config = resolve(GeneratorConfig, file=card / "recipe/config.yaml")
    given = card / "recipe" / config.material if material is None else material
    generation.generate(config.model_copy(update={"material": str(given)}), output)
    return Dataset.open(output)


@pytest.mark.usefixtures("engine")
@pytest.mark.parametrize("with_maps", [False, True])
def test_the_recipe_makes_the_same_data(with_maps: bool, tmp_path: Path) -> None:
    maps = write_maps(tmp_path / "maps")
    generation.generate(GeneratorConfig.model_validate({"material": str(maps), **SMALL}), tmp_path / "data")
    card = tmp_path / "card"
    Publication.prepare(tmp_path / "data", CONFIG, with_maps=with_maps).write(card)
    copied = {str(p.relative_to(card / "recipe")) for p in card.glob("recipe/material/**/*.*")}
    # Maps of one name are all copied.
    names = ("material.yaml", "height/map.npy", "roughness/map.npy", "base_color/color.png")
    assert copied == ({f"material/{name}" for name in names} if with_maps else set())
    maps.rename(tmp_path / "moved")
    made = remade(card, tmp_path / "made", None if with_maps else tmp_path / "moved")
    sums = dict(line.split()[::-1] for line in (card / "recipe/SHA256SUMS").read_text().splitlines())
    found = {path.name: file_sha256(path) for path in made.folder.local.iterdir() if path.name in sums}
    assert found == sums
    assert len(sums) > 2
    first, second = (contents(tmp_path / name) for name in ("data", "made"))
    for name in first:
        if name.endswith((".npz", ".exr")):
            assert first[name] == second[name], name


@pytest.mark.usefixtures("engine")
def test_changed_and_lost_maps_are_refused(tmp_path: Path) -> None:
    maps = write_maps(tmp_path / "maps")
    generation.generate(GeneratorConfig.model_validate({"material": str(maps), **SMALL}), tmp_path / "data")
    np.save(maps / "b/map.npy", np.zeros((4, 8)))
    with pytest.raises(InputError, match="has changed since the data set was made"):
        Publication.prepare(tmp_path / "data", CONFIG, with_maps=True)
    maps.rename(tmp_path / "moved")
    with pytest.raises(InputError, match="no such file or folder"):
        Publication.prepare(tmp_path / "data", CONFIG, with_maps=True)
    with pytest.raises(UsageError, match="goes with --with-maps"):
        Publication.prepare(tmp_path / "data", CONFIG, material=tmp_path / "moved")
