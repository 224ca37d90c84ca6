"""Imports of measured BTFs: values, conventions, splits, resumption, readers of one value, damaged files."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support import measured_files as files
from support.fuzzing import damaged, loads_or_refuses

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.verify import verify
from mbtf_core.errors import InputError
from mbtf_fit import fit
from mbtf_fit.cli.results import report_errors
from mbtf_fit.config import FitConfig
from mbtf_fit.data.loader import load_training
from mbtf_gen.config.exchange import ImportConfig
from mbtf_gen.generation import imported
from mbtf_gen.generation.imported import Import, import_measured
from mbtf_gen.generation.repair import repair
from mbtf_gen.measured.interface import F32
from mbtf_gen.sampling.query_sampler import direction_pairs, slice_directions
from mbtf_pipeline.compare.metrics import dataset_errors

Open = Callable[..., Import]


def known(u: NDArray[np.floating], omega_i: F32, omega_o: F32) -> F32:
    """M (n, 3) that tells positions, light, view and colors apart; positive."""
    value = 0.3 + 0.1 * np.sin(2 * np.pi * u[:, 0]) + 0.05 * np.cos(2 * np.pi * u[:, 1])
    value = value + 0.1 * omega_i[:, 0] + 0.05 * omega_o[:, 1]
    return np.asarray(value[:, None] * np.array([1.0, 0.7, 0.4]), np.float32)


class Images:
    """Images of :func:`known`, times the cosine of the light."""

    at_once = 700

    def __init__(self, lights: int = 8) -> None:
        self.rows, self.columns = 6, 12
        self.light, self.view = direction_pairs(slice_directions("spiral", lights, 0.05))
        self.left_out = 3
        self.cosine: bool | None = True
        self.calls = 0

    def values(self, pair: NDArray[np.int64], texel: NDArray[np.int64]) -> F32:
        self.calls += 1
        j, i = np.divmod(texel, self.columns)
        u = np.stack([(i + 0.5) / self.columns, 1.0 - (j + 0.5) / self.rows], -1)
        return known(u, self.light[pair], self.view[pair]) * self.light[pair, 2:]


class Listed:
    """Random queries of :func:`known`."""

    count = 1000

    def __init__(self) -> None:
        random, count = np.random.default_rng(0), self.count
        omega = slice_directions("spiral", 50, 0.2)
        self.arrays = {
            "u": random.random((count, 2), np.float32),
            "sigma": np.full(count, 0.5 / 16, np.float32),
            "omega_i": omega[random.integers(50, size=count)],
            "omega_o": omega[random.integers(50, size=count)],
        }
        self.arrays["value"] = known(self.arrays["u"], self.arrays["omega_i"], self.arrays["omega_o"])

    def read(self, start: int, stop: int) -> Any:
        return {name: a[start:stop].copy() for name, a in self.arrays.items()}


@pytest.fixture
def opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Open:
    """Opens a source as if it were a file."""
    file = tmp_path / "measured.btf"
    file.write_bytes(b"measured")

    def open_(source: Any, **options: Any) -> Import:
        monkeypatch.setattr(imported, "open_measured", lambda path: source)
        options["output"] = {"shard_queries": 300, **options.get("output", {})}
        return Import.prepare(file, ImportConfig.model_validate(options))

    return open_


def test_values_are_those_of_the_reference_plane(opened: Open, tmp_path: Path) -> None:
    job = opened(Images(), queries={"train": "20/texel", "test": "150", "min_cos": 0.2})
    summary = import_measured(job, tmp_path / "shards")
    assert summary.complete
    assert verify(tmp_path / "shards") == []
    data = Dataset.open(tmp_path / "shards")
    assert (data.lattice.finest, data.lattice.aspect, data.estimates) == (4, 0.5, 1)
    assert data.geometry() is None
    for split, count in (("train", 20 * 128), ("test", 150)):
        arrays = data.load(split)
        assert set(arrays) == {"u", "sigma", "omega_i", "omega_o", "value_a"}
        assert len(arrays["sigma"]) == count
        # The stored cosine is divided out.
        expected = known(arrays["u"], arrays["omega_i"], arrays["omega_o"])
        np.testing.assert_allclose(arrays["value_a"], expected, rtol=1e-5)
        np.testing.assert_allclose(arrays["sigma"], 0.5 / 12)
        assert min(arrays["omega_i"][:, 2].min(), arrays["omega_o"][:, 2].min()) >= 0.2
    measured = data.manifest["measured"]
    assert measured["divided_by_cosine"]
    assert measured["pairs"] == 64 + 3


def test_test_queries_have_pairs_of_their_own(opened: Open, tmp_path: Path) -> None:
    import_measured(opened(Images(), queries={"test": "500"}), tmp_path / "shards")
    data = Dataset.open(tmp_path / "shards")
    train, test = (
        {tuple(p) for p in np.concatenate([a["omega_i"], a["omega_o"]], 1).tolist()}
        for a in (data.load("train"), data.load("test"))
    )
    assert len(test) == 3
    assert not train & test
    assert len(train | test) > 55


def test_an_interrupted_import_resumes_with_the_same_bytes(opened: Open, tmp_path: Path) -> None:
    queries = {"train": "20/texel", "test": "100"}
    import_measured(opened(Images(), queries=queries), tmp_path / "whole")
    for name in ("train-00002.json", "train-00004.npz"):
        job = opened(Images(), queries=queries)
        import_measured(job, tmp_path / "part")
        before = {p.name: p.read_bytes() for p in (tmp_path / "part").glob("*.npz")}
        (tmp_path / "part" / name).unlink()
        import_measured(opened(Images(), queries=queries), tmp_path / "part")
        assert {p.name: p.read_bytes() for p in (tmp_path / "part").glob("*.npz")} == before
    assert before == {p.name: p.read_bytes() for p in (tmp_path / "whole").glob("*.npz")}
    again = Images()
    import_measured(opened(again, queries=queries), tmp_path / "part")
    assert again.calls == 0
    with pytest.raises(InputError, match="seed"):
        import_measured(opened(Images(), queries=queries, seed=1), tmp_path / "part")
    import_measured(opened(Images(), queries=queries, seed=1), tmp_path / "part", overwrite=True)
    with pytest.raises(InputError, match="cannot be generated again"):
        repair(tmp_path / "part")


@pytest.mark.parametrize("test", [100, 300, 499])
def test_blocks_of_a_list_keep_every_query_once(
    opened: Open, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, test: int
) -> None:
    monkeypatch.setattr(imported, "_BLOCK", 256)
    source = Listed()
    import_measured(opened(source, queries={"test": str(test)}), tmp_path / "shards")
    data = Dataset.open(tmp_path / "shards")
    parts = [data.load(split) for split in ("train", "test")]
    assert [len(p["sigma"]) for p in parts] == [1000 - test, test]

    def rows(*arrays: Any) -> list[tuple[float, ...]]:
        return sorted(map(tuple, np.concatenate(arrays, 1).tolist()))

    found = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
    names = ("u", "omega_i", "omega_o")
    assert rows(*(found[n] for n in names), found["value_a"]) == rows(
        *(source.arrays[n] for n in names), source.arrays["value"]
    )
    # In random order, and test queries from the whole list.
    assert (found["u"][:100] != source.arrays["u"][:100]).any()
    order = {tuple(u): k for k, u in enumerate(source.arrays["u"].tolist())}
    at = [order[tuple(u)] for u in parts[1]["u"].tolist()]
    assert min(at) < 50
    assert max(at) > 950


def test_options_select_from_a_list(opened: Open, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(imported, "_BLOCK", 256)
    source = Listed()
    queries = {"train": "123", "test": "45", "min_cos": 0.6}
    job = opened(source, queries=queries, cosine="included", scale=2.0)
    import_measured(job, tmp_path / "shards")
    data = Dataset.open(tmp_path / "shards")
    parts = [data.load(split) for split in ("train", "test")]
    assert [len(p["sigma"]) for p in parts] == [123, 45]
    lowest = np.minimum(source.arrays["omega_i"][:, 2], source.arrays["omega_o"][:, 2])
    assert data.manifest["measured"]["left_out"] == (lowest < 0.6).sum()
    found = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
    assert len(np.unique(found["u"], axis=0)) == 168
    assert min(found["omega_i"][:, 2].min(), found["omega_o"][:, 2].min()) >= 0.6
    expected = 2.0 * known(found["u"], found["omega_i"], found["omega_o"]) / found["omega_i"][:, 2:]
    np.testing.assert_allclose(found["value_a"], expected, rtol=1e-5)
    # From the whole list: its first and its last blocks.
    order = {tuple(u): k for k, u in enumerate(source.arrays["u"].tolist())}
    at = np.array([order[tuple(u)] for u in found["u"].tolist()])
    counts = np.histogram(at, bins=4, range=(0, 1000))[0]
    assert counts.min() > 25


def test_errors_of_a_fit_include_the_noise(opened: Open, tmp_path: Path) -> None:
    class Noisy(Images):
        def values(self, pair: Any, texel: Any) -> Any:
            noise = np.random.default_rng(0).normal(0, 0.05, (len(pair), 1)).astype(np.float32)
            return super().values(pair, texel) + noise * self.light[pair, 2:]

    queries = {"train": "200/texel", "test": "2000", "min_cos": 0.2}
    import_measured(opened(Noisy(lights=16), queries=queries), tmp_path / "shards")
    config = FitConfig.model_validate({"model": "neumip-baseline", "training": {"steps": 200, "batch": 4096}})
    result = fit(config, tmp_path / "shards", tmp_path / "fit")
    test = result.errors["test"]
    assert test["includes_noise"]
    assert test["mse"]["value"] == pytest.approx(0.05**2, rel=0.15)
    assert result.material.description["training"]["noise_variance"] is None
    assert any("include the noise of the data" in line for line in report_errors(result.errors, None))
    compared = dataset_errors({"a": result.material}, Dataset.open(tmp_path / "shards"))
    assert compared["a"]["splits"]["test"]["includes_noise"]
    streamed = load_training(Dataset.open(tmp_path / "shards"), config.held_out, 0, memory=None).training
    kept = load_training(Dataset.open(tmp_path / "shards"), config.held_out, 0).training
    assert (streamed.slice(5, 50).value == kept.slice(5, 50).value).all()  # type: ignore[union-attr]


CONFIG = ImportConfig.model_validate(
    {"queries": {"train": "60", "test": "20", "min_cos": 0.05}, "cosine": "included"}
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("imports")


@pytest.fixture(scope="module")
def samples(folder: Path) -> dict[str, bytes]:
    random = np.random.default_rng(0)
    shape = (2, 6, 8)
    queries = {
        "ground_color": random.random((*shape, 3)),
        "ground_camera_target_loc": random.uniform(-1, 1, (*shape, 2)),
        "ground_camera_query_radius": 0.5 ** random.uniform(1, 5, (*shape, 1)),
        "ground_camera_dir": random.uniform(-0.6, 0.6, (*shape, 2)),
        "ground_light": random.uniform(-0.6, 0.6, (*shape, 2)),
    }
    half = {name: array.astype(np.float16) for name, array in queries.items()}
    photographs = dict(list(files.photographs().items())[:3])
    return {
        "btf": files.btf(9, 2),
        "zip": files.zipped(photographs),
        "neumip": files.write_hdf5(folder / "a", half, base_radius=1 / 32).read_bytes(),
    }


def read_back(content: bytes, folder: Path) -> Dataset:
    (folder / "file").write_bytes(content)
    shutil.rmtree(folder / "shards", ignore_errors=True)
    import_measured(Import.prepare(folder / "file", CONFIG), folder / "shards")
    return Dataset.open(folder / "shards")


@pytest.mark.parametrize("name", ["btf", "zip", "neumip"])
def test_sound_files_are_imported(name: str, samples: dict[str, bytes], folder: Path) -> None:
    assert len(read_back(samples[name], folder).load("train")["sigma"]) > 20


@given(data=st.data())
@settings(max_examples=120)
def test_damaged_files(data: st.DataObject, samples: dict[str, bytes], folder: Path) -> None:
    _, content = data.draw(damaged(samples))
    found = loads_or_refuses(lambda: read_back(content, folder))
    if found is not None:
        for split in found.splits:
            if found.shards(split):
                found.load(split)
