"""Fits of several data sets that share one network, and fits that keep a network as it is."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from support.fit_data import F32, parallax, write_data
from support.killed_fits import Killed, run_killed
from support.known_surfaces import geometry, rough_heights

import mbtf_fit.training.fit
import mbtf_fit.training.fit_export
import mbtf_fit.training.trainer
from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import InputError
from mbtf_fit import FitConfig, FitResult, Material, fit
from mbtf_fit.evaluation import evaluate
from mbtf_fit.material.decoder import Decoder, network_tensors
from mbtf_fit.training.fit import fit_jointly
from mbtf_fit.training.fit_export import Member
from mbtf_fit.training.fit_folder import read_history
from mbtf_fit.training.trainer import Trainer

NAMES = ("waves", "stripes", "third")
BATCH = {"batch": 512, "warmup": 10}


def stripes(u: F32, sigma: F32, omega_i: F32, omega_o: F32) -> NDArray[np.float64]:
    """Bright stripes, which the light's azimuth shifts."""
    fade = np.exp(-2 * (2 * np.pi * sigma) ** 2)
    wave = np.sin(2 * np.pi * (u[:, 1] + 0.1 * omega_i[:, 0])) * fade
    return (0.5 * (1 + 0.7 * wave) * (0.5 + 0.5 * omega_i[:, 2]))[:, None] * np.array([0.5, 0.8, 1.0])


def third(u: F32, sigma: F32, omega_i: F32, omega_o: F32) -> NDArray[np.float64]:
    """Between the two."""
    return 0.4 * parallax(u[:, ::-1], sigma, omega_i, omega_o) + 0.1 * stripes(u, sigma, omega_i, omega_o)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("data")
    functions = dict(zip(NAMES, (parallax, stripes, third), strict=True))
    # The materials differ in resolution, surface and brightness.
    sizes = {"waves": 3, "stripes": 2, "third": 3}
    for k, (name, function) in enumerate(functions.items()):
        lattice = Lattice(sizes[name])
        rough = geometry(lattice, rough_heights(16, 16, 0.05, k), roughness=0.5, metallic=0.2, seed=k)
        options = {"train": 4000, "test": 1000, "finest": lattice.finest, "noise": 0.01, "geometry": rough}
        write_data(folder / name, function, **options)  # type: ignore[arg-type]
    return {name: folder / name for name in NAMES}


def joint_config(model: str = "relief", steps: int = 300) -> FitConfig:
    return single_config(model, steps, shared_decoder=True)


def single_config(
    model: str = "relief", steps: int = 100, shared_decoder: bool = False, **options: Any
) -> FitConfig:
    training = {"steps": steps, "shared_decoder": shared_decoder, **BATCH}
    return FitConfig.model_validate({"model": model, "training": training, **options})


def fit_two(config: FitConfig, data: dict[str, Path], out: Path, **options: Any) -> list[FitResult]:
    names = NAMES[:2]
    folders = [out / name for name in names]
    return fit_jointly(config, [data[name] for name in names], folders, **options)


@pytest.fixture(scope="module", params=["relief", "neumip"])
def library_folder(
    data: dict[str, Path], tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> Path:
    """Materials that share a network."""
    out = tmp_path_factory.mktemp(request.param)
    fit_two(joint_config(request.param), data, out)
    return out


def networks_of(folder: Path) -> dict[str, torch.Tensor]:
    return network_tensors(Material.load(folder).model)


def unexplained(folder: Path, shards: Path) -> float:
    value = evaluate(Material.load(folder), shards)["errors"]["test"]["unexplained"]["value"]
    assert value is not None
    return value


def test_materials_share_the_bits_of_one_network(library_folder: Path) -> None:
    first, second = (Material.load(library_folder / name).model for name in NAMES[:2])
    shared, own = network_tensors(first), network_tensors(second)
    assert own.keys() == shared.keys()
    assert all(torch.equal(own[name], shared[name]) for name in shared)
    assert ("offset_network.0.weight" in shared) == (first.name == "neumip")
    # All else is the material's own.
    assert first.unit != second.unit
    assert not torch.equal(first.calibration, second.calibration[:, :3])
    if first.name == "relief":
        assert not torch.equal(first.depth_weights[:3], second.depth_weights)


def test_joint_fits_learn_each_material(library_folder: Path, data: dict[str, Path], tmp_path: Path) -> None:
    model = Material.load(library_folder / "waves").model.name
    fit_two(joint_config(model, steps=2), data, tmp_path)
    for name in NAMES[:2]:
        after = unexplained(library_folder / name, data[name])
        assert after < 0.25
        assert after < 0.5 * unexplained(tmp_path / name, data[name])
        stated = Material.load(library_folder / name).description["training"]["errors"]
        assert stated["test"]["unexplained"]["value"] == pytest.approx(after, rel=1e-6)


def test_steps_take_the_materials_in_turn(data: dict[str, Path], tmp_path: Path) -> None:
    result = fit_two(joint_config(steps=7), data, tmp_path)
    summaries = [found.material.description["training"] for found in result]
    assert [summary["steps"] for summary in summaries] == [4, 3]
    assert summaries[0]["shared_decoder"]["steps"] == 7
    seconds = summaries[0]["shared_decoder"]["seconds"]
    assert summaries[0]["seconds"] == pytest.approx(seconds * 4 / 7, abs=1e-3)
    assert [record["step"] for record in read_history(tmp_path / "stripes")][-1] == 7


def test_a_kept_network_keeps_its_bits(library_folder: Path, data: dict[str, Path], tmp_path: Path) -> None:
    model = Material.load(library_folder / "waves").model.name
    shared = networks_of(library_folder / "waves")
    errors = []
    for steps in (1, 150):
        out = tmp_path / str(steps)
        fit(single_config(model, steps, decoder=str(library_folder / "waves")), data["third"], out)
        found = networks_of(out)
        assert all(torch.equal(found[name], shared[name]) for name in shared)
        errors.append(unexplained(out, data["third"]))
    assert errors[1] < min(0.5, 0.8 * errors[0])
    before, after = (Material.load(tmp_path / steps).model for steps in ("1", "150"))
    assert not torch.allclose(before.pyramid.texels, after.pyramid.texels, atol=1e-3)
    if model == "relief":
        assert not torch.allclose(before.depth_weights, after.depth_weights, atol=1e-3)
    else:
        assert not torch.allclose(before.offset_texture.texels, after.offset_texture.texels, atol=1e-5)


def test_a_fit_does_not_replace_what_it_starts_from(data: dict[str, Path], tmp_path: Path) -> None:
    fit(single_config(steps=2), data["waves"], tmp_path / "m")
    before = Decoder.find(tmp_path / "m").sha256
    with pytest.raises(InputError, match="m: holds what the fit starts from"):
        fit(
            single_config(steps=2, decoder=str(tmp_path / "m")),
            data["stripes"],
            tmp_path / "m",
            overwrite=True,
        )
    assert Decoder.find(tmp_path / "m").sha256 == before


def test_another_decoder_is_another_fit(data: dict[str, Path], tmp_path: Path) -> None:
    wanted = single_config(steps=3, decoder=str(tmp_path / "m"))
    fit(single_config(steps=3), data["waves"], tmp_path / "m")
    fit(wanted, data["third"], tmp_path / "n")
    assert fit(wanted, data["third"], tmp_path / "n").resumed
    fit(single_config(steps=4), data["waves"], tmp_path / "m", overwrite=True)
    with pytest.raises(InputError, match="holds a fit of another configuration"):
        fit(wanted, data["third"], tmp_path / "n")


@pytest.mark.parametrize("model", ["relief", "neumip"])
def test_a_killed_joint_fit_ends_with_the_same_bits(
    data: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, model: str
) -> None:
    monkeypatch.setattr(mbtf_fit.training.fit, "_REPORT_SECONDS", 0.0)
    monkeypatch.setattr(mbtf_fit.training.fit, "_CHECKPOINT_SECONDS", 0.0)
    config = joint_config(model, steps=9)
    whole = fit_two(config, data, tmp_path / "whole")
    out, export, exports = tmp_path / "killed", mbtf_fit.training.fit_export.export_fit, 0

    def dying_export(*arguments: Any, **more: Any) -> None:
        nonlocal exports
        exports += 1
        # Between the two materials, once.
        if exports == 2:
            raise Killed
        export(*arguments, **more)

    monkeypatch.setattr(mbtf_fit.training.fit_export, "export_fit", dying_export)
    found, kills = run_killed(monkeypatch, lambda: fit_two(config, data, out))
    assert exports > 2
    assert kills >= 2
    for mine, other in zip(found, whole, strict=True):
        expected = other.material.model.weights()
        weights = mine.material.model.weights()
        assert all(torch.equal(weights[name], expected[name]) for name in expected)
        assert mine.errors == other.errors
        steps = [record["step"] for record in read_history(mine.folder)]
        assert steps == sorted(set(steps))
    assert not list(out.glob("*/checkpoint.safetensors"))
    # A finished one is kept.
    monkeypatch.undo()
    assert all(again.resumed for again in fit_two(config, data, out))


def test_a_lost_material_is_fitted_again(
    data: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where it is killed once all folders hold a material, the last one that of the first fit."""
    fit_two(joint_config(steps=2), data, tmp_path)
    shutil.rmtree(tmp_path / "waves")
    export = mbtf_fit.training.fit_export.export_fit

    def dying_export(
        trainer: Trainer, config: FitConfig, member: Member, *arguments: Any, **more: Any
    ) -> None:
        if member.folder.name == "stripes":
            raise Killed
        export(trainer, config, member, *arguments, **more)

    with monkeypatch.context() as patch:
        patch.setattr(mbtf_fit.training.fit_export, "export_fit", dying_export)
        with pytest.raises(Killed):
            fit_two(joint_config(steps=2), data, tmp_path)
    before = (tmp_path / "stripes" / "material.json").stat().st_ino
    assert [found.resumed for found in fit_two(joint_config(steps=2), data, tmp_path)] == [True] * 2
    assert (tmp_path / "stripes" / "material.json").stat().st_ino != before


def test_other_data_sets_are_another_fit(data: dict[str, Path], tmp_path: Path) -> None:
    fit_two(joint_config(steps=2), data, tmp_path)
    names = ("waves", "third")
    arguments = [data[name] for name in names], [tmp_path / name for name in names]
    with pytest.raises(InputError, match=r"waves: holds a fit of another configuration.*\n.*--overwrite"):
        fit_jointly(joint_config(steps=2), *arguments)
    with pytest.raises(InputError, match=r"waves: holds a fit of another configuration: .*shared_decoder"):
        fit(single_config(steps=2), data["waves"], tmp_path / "waves")
    fit_jointly(joint_config(steps=2), *arguments, overwrite=True)
    first, second = (networks_of(tmp_path / name) for name in names)
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_other_architectures_are_refused(data: dict[str, Path], tmp_path: Path) -> None:
    fit(single_config(steps=2), data["waves"], tmp_path / "m")
    others: list[tuple[dict[str, Any], str]] = [
        ({"model": "neumip"}, r"its network has model relief, the fit neumip"),
        ({"network": {"width": 16}}, r"its network has network\.width 25, the fit 16"),
        ({"network": {"encoding": {"half_vector": False}}}, r"network\.encoding\.half_vector True, the fit"),
    ]
    for options, message in others:
        wanted = FitConfig.model_validate({"decoder": str(tmp_path / "m"), **options})
        with pytest.raises(InputError, match=message):
            fit(wanted, data["waves"], tmp_path / "n")
    assert not (tmp_path / "n").exists()
