"""Images and slices: order, what is held out of them, patches, models of neighborhoods, damaged data."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.datasets import rewrite
from support.fit_data import constant, parallax, random_images, random_queries, write_data, write_images
from support.slice_data import write_slices

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.lattice import Lattice, sigma_of_level
from mbtf_core.data.shard_files import read_shard
from mbtf_core.errors import InputError
from mbtf_fit import FitConfig, Material, evaluate, fit
from mbtf_fit.config import build_model
from mbtf_fit.data.layouts import (
    DECODED,
    SharedSlices,
    TrainingImages,
    TrainingSlices,
    nearest_shapes,
    strides,
)
from mbtf_fit.data.loader import Partition, in_region, load_training
from mbtf_fit.sections import HeldOutSection
from mbtf_gen.sampling.query_sampler import LevelMixture, QueryPlan

HELD_OUT = HeldOutSection(queries=0.1, radius=0.3)


def partition(folder: Path, held_out: HeldOutSection = HELD_OUT, seed: int = 0) -> Partition:
    return load_training(Dataset.open(folder), held_out, seed)


def numbered(q: Mapping[str, np.ndarray], *shape: np.ndarray) -> TrainingImages:
    """Images of queries (images, rows, columns, ...); the value's first channel numbers the queries."""
    number = np.arange(q["sigma"].size, dtype=np.float32).reshape(q["sigma"].shape)
    value = np.stack([number, 0 * number, 0 * number], -1)
    arrays = (q["u"], *(q[name][:, 0, 0] for name in ("sigma", "omega_i", "omega_o")), value)
    tensors = [torch.from_numpy(np.ascontiguousarray(a, np.float32)) for a in arrays]
    return TrainingImages(*tensors, *shape)  # type: ignore[arg-type]


def images(lattice: Lattice, levels: list[float], *, regular: bool) -> TrainingImages:
    """One image per level."""
    q = random_images(np.random.default_rng(0), len(levels), lattice, regular=regular)
    q["sigma"][:] = sigma_of_level(levels)[:, None, None]
    return numbered(q, strides(lattice, q["sigma"][:, 0, 0]))


def test_whole_images_are_held_out(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "d", parallax, train=60)
    many = HeldOutSection(queries=0.4, radius=0.3)
    part = partition(folder, many)
    training = part.training
    assert isinstance(training, TrainingImages)
    for q in (training, part.held_out_queries):
        for omega in (q.omega_i, q.omega_o):
            assert not in_region(many, np.asarray(omega)).any()
    out = part.held_out_directions
    assert (in_region(HELD_OUT, out.omega_i) | in_region(HELD_OUT, out.omega_o)).all()
    kept = {row.tobytes() for row in training.omega_i.numpy()}
    held = [{row.tobytes() for row in q.omega_i} for q in (part.held_out_queries, out)]
    parts = (training, part.held_out_queries, out)
    assert [64 * len(s) for s in (kept, *held)] == [len(p) for p in parts]
    assert len(kept | held[0] | held[1]) == 60
    assert len(held[0]) == round(0.4 * (60 - len(held[1])))
    again = partition(folder, many)
    np.testing.assert_array_equal(again.held_out_queries.u, part.held_out_queries.u)
    other = {row.tobytes() for row in partition(folder, many, seed=1).held_out_queries.omega_i}
    assert other != held[0]


def test_batches_take_every_image_and_resume_anywhere() -> None:
    data = images(Lattice(3), [1.0, 2.0, 3.0, 2.5, 0.5], regular=False)
    batches = list(islice(data.batches(32, 7, 0, 4), 10))
    assert all(len(b) == 1 and b.value.shape == (1, 6, 6, 3) for b in batches)
    seen = [float(b.sigma[0]) for b in batches]
    assert len(set(seen[:5])) == len(set(seen[5:])) == 5
    again = next(data.batches(32, 7, 6, 4))
    torch.testing.assert_close(again.u, batches[6].u, rtol=0, atol=0)
    many = next(data.batches(12 * 64, 7, 0, 4))
    assert many.value.shape == (12, 8, 8, 3)
    assert len(many.sigma.unique()) == 5


def small_images(lattice: Lattice, size: int, count: int) -> TrainingImages:
    """Images of limited size, as the generator draws them."""
    q = QueryPlan(lattice, LevelMixture(1, 0), 0.2, "image", 3, count, patch_size=size).draw(
        "train", 0, count
    )
    return numbered(vars(q), np.ones((count, 2), np.int64), nearest_shapes(lattice, q.sigma[:, 0, 0]))


def test_patches_extend_beyond_the_border_of_small_images() -> None:
    lattice = Lattice(4, 0.5)
    data = small_images(lattice, 6, 30)
    origin = np.array([[k % 3, k // 3 % 3] for k in range(30)])
    patches = data.patches(np.arange(30), origin, 4, 3)
    assert patches.u.shape == (30, 10, 10, 2)
    number = patches.value[..., 0].long()
    assert number[5, 0, 0] == 5 * 36 + 2 * 6 + 1
    assert number[5, 1, 3] == 5 * 36 + 3 * 6 + 4
    apart = patches.u[:, 3:7, 3:7] - data.u.view(-1, 2)[number]
    torch.testing.assert_close(apart, apart.round(), atol=1e-6, rtol=0)
    for item in range(30):
        rows, columns = nearest_shapes(lattice, patches.sigma[item : item + 1].numpy())[0]
        step = patches.u[item, 1:, 1:] - patches.u[item, :-1, :-1] - torch.tensor([1 / columns, -1 / rows])
        torch.testing.assert_close(step, step.round().to(step.dtype), atol=1e-6, rtol=0)


@pytest.mark.parametrize("cut", ["whole", "patch_sizes"])
@pytest.mark.parametrize("aspect", [1.0, 0.5])
@pytest.mark.parametrize("decoder", ["inception", "mlp"])
def test_training_and_evaluation_agree_on_regular_images(aspect: float, decoder: str, cut: str) -> None:
    """The answer of a patch is that of its queries one by one, in any order."""
    lattice = Lattice(4, aspect)
    model = build_model("hierarchical", lattice, decoder=decoder)
    model.initialize(torch.Generator().manual_seed(0), 0.1)
    torch.nn.init.normal_(model.pyramid.texels, generator=torch.Generator().manual_seed(1))
    torch.nn.init.normal_(model.offset_texture.texels, generator=torch.Generator().manual_seed(2))
    whole = cut == "whole"
    data = images(lattice, [4.0, 3.0, 2.3, 1.0, 0.0], regular=True) if whole else small_images(lattice, 6, 5)
    m = model.margin
    origin = np.array([[0, 0], [3, 9], [1, 1], [7, 15], [5, 2]]) if whole else np.zeros((5, 2), np.int64)
    patches = data.patches(np.arange(5), origin, 6, m)
    with torch.no_grad():
        together = model.evaluate_patches(patches.u, patches.sigma, patches.omega_i, patches.omega_o)
        order = torch.randperm(5 * 36)
        item = order // 36
        u = patches.u[:, m : m + 6, m : m + 6].reshape(-1, 2)[order]
        alone = model(u, patches.sigma[item], patches.omega_i[item], patches.omega_o[item])
    assert together.shape == (5, 6, 6, 3)
    assert together.std() > 0.01
    torch.testing.assert_close(alone, together.reshape(-1, 3)[order], rtol=2e-3, atol=1e-5)


def quick(steps: int, **network: object) -> FitConfig:
    training = {"steps": steps, "batch": 1024, "warmup": 5}
    return FitConfig.model_validate({"model": "hierarchical", "network": network, "training": training})


def test_a_hierarchical_material_is_fitted_and_loads_again(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "d", parallax, train=300, test=20, noise=0.005)
    result = fit(quick(200), folder, tmp_path / "m")
    assert result.errors["test"]["unexplained"]["value"] < 0.4
    material = Material.load(tmp_path / "m")
    assert material.deviation() < 1e-6
    # Evaluated on data of either layout, in any company.
    shuffled = write_data(tmp_path / "s", parallax, train=2000, test=500)
    errors = evaluate(material, shuffled)["errors"]["test"]
    assert errors["n"] == 500
    assert errors["unexplained"]["value"] < 0.5
    queries = random_queries(np.random.default_rng(3), 1000, material.lattice)
    found = material.evaluate(*queries.values())
    alone = material.evaluate(*(a[500:501] for a in queries.values()))
    np.testing.assert_allclose(alone[0], found[500], rtol=1e-4, atol=1e-6)


def test_the_other_layout_is_refused_with_a_hint(tmp_path: Path) -> None:
    shuffled = write_data(tmp_path / "s", constant(0.1), train=100)
    with pytest.raises(InputError, match=r"shuffled layout, but hierarchical .*\n.*--layout image"):
        fit(quick(1), shuffled, tmp_path / "m")
    image = write_images(tmp_path / "d", constant(0.1), train=4)
    for config in (FitConfig(model="neumip"), FitConfig(model="relief")):
        message = rf"image layout, but {config.model} .*\n.*--layout shuffled"
        with pytest.raises(InputError, match=message):
            fit(config, image, tmp_path / "m")


def place(u, sigma, omega_i, omega_o):  # type: ignore[no-untyped-def]
    """Position and directions as a color."""
    return np.stack([u[:, 0], u[:, 1], omega_i[:, 0] + 2 * omega_o[:, 1]], axis=-1)


@pytest.mark.parametrize("aspect", [1.0, 0.5])
def test_slices_are_in_the_order_of_the_texels(tmp_path: Path, aspect: float) -> None:
    data = Dataset.open(write_slices(tmp_path / "data", place, aspect=aspect))
    found = load_training(data, HeldOutSection(queries=0.05), 0)
    slices = found.training
    assert isinstance(slices, TrainingSlices)
    rows, columns = data.lattice.shape()
    j, i = np.divmod(np.arange(rows * columns), columns)
    values = slices.values.numpy()
    np.testing.assert_allclose(values[:, 0, 0], (i + 0.5) / columns, atol=1e-6)
    np.testing.assert_allclose(values[:, 0, 1], 1 - (j + 0.5) / rows, atol=1e-6)
    expected = slices.omega_i[:, 0] + 2 * slices.omega_o[:, 1]
    np.testing.assert_allclose(values[3, :, 2], expected.numpy(), atol=1e-6)


def test_held_out_pairs_are_not_trained_on(tmp_path: Path) -> None:
    data = Dataset.open(write_slices(tmp_path / "data"))
    found = load_training(data, HeldOutSection(queries=0.1, radius=0.2), 0)
    slices = found.training
    assert isinstance(slices, TrainingSlices)
    pairs = {tuple(p) for p in torch.cat([slices.omega_i, slices.omega_o], 1).tolist()}
    for held in (found.held_out_queries, found.held_out_directions):
        assert len(held) > 100
        assert not pairs & {tuple(p) for p in np.concatenate([held.omega_i, held.omega_o], 1).tolist()}
    for omega in (slices.omega_i, slices.omega_o):
        assert ((omega[:, :2] - torch.tensor([0.45, 0.3])).square().sum(1) >= 0.2**2).all()
    sampled = np.concatenate([found.sample.omega_i, found.sample.omega_o], 1).tolist()
    assert {tuple(p) for p in sampled} <= pairs
    assert len(pairs) < 100


def test_a_batch_decodes_pairs_of_whole_slices(tmp_path: Path) -> None:
    found = load_training(Dataset.open(write_slices(tmp_path / "data")), HeldOutSection(), 0)
    slices = found.training
    assert isinstance(slices, TrainingSlices)
    batch, again = next(slices.batches(640, 1, 5)), next(slices.batches(640, 1, 5))
    assert len(batch) == 640 // DECODED
    assert torch.equal(batch.chosen, again.chosen)
    assert torch.equal(batch.values, again.values)
    queries = batch.queries()
    k = batch.chosen.shape[1]
    assert torch.equal(queries.value[k + 2], batch.values[1, batch.chosen[1, 2]])
    assert torch.equal(queries.omega_o[k + 2], batch.omega_o[batch.chosen[1, 2]])
    # Other steps have other texels.
    assert not torch.equal(batch.values, next(slices.batches(640, 1, 6)).values)
    shared = SharedSlices(slices, [slices.scaled(2.0), slices])
    assert len(shared) == 2 * len(slices)
    assert torch.equal(next(shared.batches(640, 1, 4)).values, 2 * next(slices.batches(640, 1, 4)).values)


def test_slices_are_queries_in_random_order(tmp_path: Path) -> None:
    data = Dataset.open(write_slices(tmp_path / "data", place, aspect=0.5))
    slices = load_training(data, HeldOutSection(queries=0.05), 0).training
    assert isinstance(slices, TrainingSlices)
    queries = slices.as_queries(data.lattice, 3)
    expected = place(queries.u.numpy(), None, queries.omega_i.numpy(), queries.omega_o.numpy())
    np.testing.assert_allclose(queries.value.numpy(), expected, atol=1e-6)
    assert len(torch.unique(torch.cat([queries.u, queries.omega_i, queries.omega_o], 1), dim=0)) == len(
        slices
    )
    # A batch has queries of the whole tile.
    assert queries.u[:200].std(0).numpy() == pytest.approx(12**-0.5, abs=0.05)
    assert not torch.equal(queries.u, slices.as_queries(data.lattice, 4).u)


@pytest.mark.parametrize(
    ("name", "changed", "message"),
    [
        ("omega_i", lambda a: a[1][::-1], "do not share their directions"),
        ("u", lambda a: a[0], "lacks slices of some texels"),
    ],
)
def test_damaged_slices_are_refused(tmp_path: Path, name: str, changed: Any, message: str) -> None:
    shards = write_slices(tmp_path / "data")
    array = read_shard(shards / "train-00000.npz", mapped=False)[name].copy()
    array[1] = changed(array)
    rewrite(shards / "train-00000.npz", **{name: array})
    with pytest.raises(InputError, match=message):
        load_training(Dataset.open(shards), HeldOutSection(), 0)
