"""Buffers and images of a mesh are inputs: a data set is not resumed, repaired or sent around with others."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.formula_runs import SMALL, Formula, listing
from support.gltf_files import SQUARE, GltfBuilder, png

from mbtf_core.data.dataset import Dataset
from mbtf_core.errors import InputError
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation.repair import repair
from mbtf_gen.generation.run import generate
from mbtf_gen.job import Job
from mbtf_gen.publishing.recipe import recipe_files


@pytest.fixture
def config(tmp_path: Path, engine: Formula, monkeypatch: pytest.MonkeyPatch) -> GeneratorConfig:
    """A run on a mesh of three files."""
    estimate = engine.estimate

    def with_gaps(queries: Any, spp: int, stream: Any) -> Any:
        return replace(estimate(queries, spp, stream), transmittance=np.zeros(len(queries.sigma), np.float32))

    monkeypatch.setattr(engine, "estimate", with_gaps)
    builder = GltfBuilder()
    builder.add("images", {"uri": "wood.png"})
    builder.add("textures", {"source": 0})
    builder.plate(builder.material({"baseColorTexture": {"index": 0}}))
    builder.node(builder.mesh(np.add(SQUARE, (0, 0.25, 0))))
    (tmp_path / "wood.png").write_bytes(png(np.full((2, 2, 3), 128, np.uint8)))
    path = builder.write(tmp_path / "a.gltf")
    return GeneratorConfig.model_validate({"material": str(path), **SMALL})


CHANGES: dict[str, Callable[[bytes], bytes]] = {
    "wood.png": lambda content: png(np.full((2, 2, 3), 129, np.uint8)),
    "a.bin": lambda content: content + b" ",
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_changed_companion_is_another_data_set(
    config: GeneratorConfig, tmp_path: Path, out: Path, name: str
) -> None:
    generate(config, out)
    role = f"mesh.{name}"
    assert role in Dataset.open(out).manifest["inputs"]
    (out / "train-00001.npz").unlink()
    before, sent = listing(out), pickle.dumps(Job.load(config))
    whole = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(CHANGES[name](whole))
    for act in (lambda: generate(config, out), lambda: repair(out)):
        with pytest.raises(InputError, match=role):
            act()
        assert listing(out) == before
    with pytest.raises(InputError, match="differ on this machine"):
        pickle.loads(sent)
    (tmp_path / name).write_bytes(whole)
    assert repair(out).complete


def test_companions_are_not_published(config: GeneratorConfig, out: Path) -> None:
    generate(config, out)
    with pytest.raises(InputError, match="names other files"):
        recipe_files(Dataset.open(out), with_maps=True, moved=None)
