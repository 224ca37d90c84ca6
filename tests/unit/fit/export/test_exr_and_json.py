"""Exports: what is written suffices to evaluate a material without this project."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.material_cases import ALL, make
from support.plugin_materials import write_material

from mbtf_core.app.console import CONSOLE
from mbtf_core.errors import InputError
from mbtf_fit import Material
from mbtf_fit.export import Export, targets
from mbtf_fit.material.material import export
from mbtf_fit.material.numpy_reader import NumpyMaterial
from mbtf_fit.material.rounding import round_material
from mbtf_fit.material.texture_formats import TextureFormat
from mbtf_fit.models.registry import MODELS

F64 = NDArray[np.float64]


# Every operation is read below; these differ in what the files hold.
CASES = (
    "calibrated",
    "holes",
    "hierarchical, eleven channels",
    "calibrated relief",
    "learned heights, diffuse",
)


class Reader(NumpyMaterial):
    """Evaluates ``layers.json`` and ``textures.exr`` by the reader of the documentation."""

    def __init__(self, folder: Path) -> None:
        import OpenEXR

        self.document = json.loads((folder / "layers.json").read_text())
        tensors: dict[str, F64] = {n: np.array(t) for n, t in self.document["tensors"].items()}
        with OpenEXR.File(str(folder / "textures.exr"), separate_channels=True) as file:
            for part in file.parts:
                letter = "c" if part.name().startswith("transmittance") else "f"
                assert sorted(part.channels) == list(part.channels)
                assert {name[0] for name in part.channels} == {letter}
                planes = [np.array(c.pixels, np.float64) for c in part.channels.values()]
                tensors[part.name()] = np.stack(planes, -1)
        assert set(self.document["textures"]) <= set(tensors)
        super().__init__(self.document, tensors)

    def value(self) -> F64:
        known = self.document["conformance"]
        return np.asarray(self.evaluate(*(np.array(known[k]) for k in ("u", "sigma", "omega_i", "omega_o"))))

    def transmittance(self) -> F64:
        known = self.document["conformance"]
        u, sigma, omega_o = (np.array(known[k]) for k in ("u", "sigma", "omega_o"))
        level = np.clip(-np.log2(2 * sigma), 0, self.finest)
        x, y = omega_o[:, 0], omega_o[:, 1]
        total, terms = np.zeros(len(u)), np.stack([x**0, x, y, x * x, x * y, y * y], -1)
        for k, z in enumerate(self.document["transmittance"]["depths"]):
            at = u + z / np.maximum(omega_o[:, 2:], 0.05) * np.stack([x, y], -1) / self.scale
            read = zip(at, level[:, None], strict=True)
            total += (np.array([self.lookup(p, s, f"transmittance.{k}") for p, s in read]) * terms).sum(-1)
        return np.clip(total, 0, 1)


@pytest.mark.parametrize("form", ["float32", "float16", "bc4"])
@pytest.mark.parametrize("case", CASES)
def test_an_export_is_sufficient_for_evaluation(case: str, form: TextureFormat, tmp_path: Path) -> None:
    """An evaluation written from the description alone, in NumPy, meets the conformance values."""
    material = make(case, tmp_path, contrast=1.0)
    written, half = round_material(material, form)[0], form != "float32"
    for name in ("exr", "json"):
        targets()[name].write(Export(tmp_path, tmp_path, written, form, CONSOLE), None)
    reader = Reader(tmp_path)
    assert reader.document["precision"] == form
    expected = np.array(reader.document["conformance"]["rgb"])
    assert expected.std() > 0.005
    found = reader.value()
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-5)
    assert (expected.astype(np.float32) == material.conformance["rgb"]).all() != half
    kinds = {op["operation"] for op in reader.document["operations"]}
    assert ("calibrate" in kinds) == (case in ("calibrated", "calibrated relief", "holes"))
    assert ("transmittance" in reader.document) == (case == "holes")
    if case == "holes":
        through = np.array(reader.document["conformance"]["transmittance"])
        assert through.std() > 0.1
        np.testing.assert_allclose(reader.transmittance(), through, atol=2e-5)
        queries = (material.conformance[k] for k in ("u", "sigma", "omega_o"))
        assert material.transmittance is not None
        assert (material.transmittance.evaluate(*queries) == through.astype(np.float32)).all() != half


def test_a_material_in_half_precision_loads_like_any_other(tmp_path: Path) -> None:
    material = make("hierarchical", tmp_path / "single")
    rounded, error = round_material(material, "float16")
    (tmp_path / "half").mkdir()
    training = material.description["training"]
    export(rounded.model, rounded.config, tmp_path / "half", data={}, training=training, form="float16")
    loaded = Material.load(tmp_path / "half")
    sizes = [(tmp_path / n / "weights.safetensors").stat().st_size for n in ("single", "half")]
    assert sizes[1] < 0.75 * sizes[0]
    # The conformance values are those of PyTorch, not of the kernel.
    assert loaded.deviation() < 1e-6 * loaded.conformance["rgb"].max()
    queries = [loaded.conformance[k] for k in ("u", "sigma", "omega_i", "omega_o")]
    difference = loaded.evaluate(*queries) - material.conformance["rgb"]
    assert np.abs(difference).max() == pytest.approx(error.largest, rel=1e-3)


def test_numbers_beyond_half_precision_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"'pyramid\.\d' holds .* beyond half precision"):
        round_material(
            write_material(tmp_path, network={"output_transform": "identity"}, contrast=1e5), "float16"
        )


@pytest.mark.parametrize("case", ALL)
def test_the_reader_gives_the_conformance_values(case: str, tmp_path: Path) -> None:
    material = make(case, tmp_path / "material")
    expected = material.conformance["rgb"]
    queries = [material.conformance[name] for name in ("u", "sigma", "omega_i", "omega_o")]
    found = NumpyMaterial.load(tmp_path / "material").evaluate(*queries)
    assert (expected.std() > 0) == (case != "black")
    np.testing.assert_array_less(abs(found - expected), 1e-4 * np.maximum(1.0, expected))


def test_every_model_is_read() -> None:
    assert {options.get("model", "neumip") for options in ALL.values()} == set(MODELS)
