"""The recipe makes the same data again; a planted difference is found; maps are copied whole."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from support.datasets import rewrite
from support.formula_runs import SMALL, Formula, cheap_plan
from support.published import contents, publish, small

from mbtf_core.config.settings import resolve
from mbtf_core.data.dataset import Dataset
from mbtf_core.errors import InputError, UsageError
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.config.publish import PublishConfig
from mbtf_gen.generation import run as generation
from mbtf_gen.publishing.digests import digest_faults
from mbtf_gen.publishing.publication import Publication

CONFIG = PublishConfig(license="CC0-1.0", form="webdataset")


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


def test_digests_are_those_of_the_numbers(tmp_path: Path) -> None:
    small(tmp_path / "data")
    card = publish(tmp_path / "data", tmp_path / "card", form="npz")
    arrays: dict[str, Any] = json.loads((card / "recipe/digests.json").read_text())["arrays"]
    assert set(arrays) == {path.stem for path in (tmp_path / "data").glob("*.npz")}
    for stem, digests in arrays.items():
        with np.load(tmp_path / f"data/{stem}.npz") as shard:
            assert digests == {n: hashlib.sha256(shard[n].tobytes()).hexdigest() for n in shard.files}


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
    assert digest_faults(made, card / "recipe/digests.json") == []
    first, second = (contents(tmp_path / name) for name in ("data", "made"))
    for name in first:
        if name.endswith((".npz", ".exr")):
            assert first[name] == second[name], name


def test_differences_are_found_and_explained(tmp_path: Path) -> None:
    small(tmp_path / "data")
    digests = publish(tmp_path / "data", tmp_path / "card", form="npz") / "recipe/digests.json"
    assert digest_faults(Dataset.open(tmp_path / "data"), digests) == []
    path = tmp_path / "data/train-00001.npz"
    before, sidecar = path.read_bytes(), path.with_suffix(".json").read_bytes()
    with np.load(path) as shard:
        value, sigma = shard["value_b"].copy(), shard["sigma"].copy()
    value[3, 1] = np.nextafter(value[3, 1], np.float32(np.inf))
    rewrite(path, value_b=value)
    found = digest_faults(Dataset.open(tmp_path / "data"), digests)
    assert found[0] == "value_b differs in 1 of 3 shards, first train-00001"
    assert "values are equal on one type of machine" in found[1]
    document = json.loads(digests.read_text())
    document["software"]["mitsuba"] = "3.8.0"
    digests.write_text(json.dumps(document))
    assert "mitsuba 3.8.0 -> " in digest_faults(Dataset.open(tmp_path / "data"), digests)[-1]
    path.write_bytes(before)
    path.with_suffix(".json").write_bytes(sidecar)
    sigma[0] *= np.float32(0.5)
    rewrite(path, sigma=sigma)
    found = digest_faults(Dataset.open(tmp_path / "data"), digests)
    assert found[0].startswith("sigma differs")
    assert "another data set" in found[1]


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
