"""Exports: what is written suffices to evaluate a material without this project."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from support.plugin_materials import net, write_material
from support.surface_formulas import WrittenSurface, bilinear, rotate

from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import InputError
from mbtf_fit import Material
from mbtf_fit.material.export import to_half, write_layers, write_textures
from mbtf_fit.material.material import export
from mbtf_fit.material.transmittance import Transmittance

F64 = NDArray[np.float64]


FILTERED = {"raw": True, "band_attenuation": True, "footprint_filtered": True}
CASES: dict[str, dict[str, Any]] = {
    "baseline": {"model": "neumip-baseline"},
    "calibrated": {},
    "with holes": {},
    "neumip": {},
    "direct, six outputs": net(offset="direct", output_channels=6, activation="leaky-relu"),
    "concatenated": net(blending="concatenate", activation="sine", output_transform="softplus"),
    "hierarchical": {"model": "hierarchical"},
    "eleven channels": {
        "model": "hierarchical",
        **net(decoder="mlp", channels=11, encoding={"raw": True, "direction_xyz": True}),
    },
    "half vector": net(encoding={"direction_xyz": True, "half_vector": True}),
    "relief": {"model": "relief"},
    "learned heights": {"model": "neumip+", "glossy": False},
    "calibrated relief": {"model": "relief"},
    "relief, four places": {
        "model": "relief",
        "glossy": False,
        **net(relief={"places": 4}, encoding={"half_vector": False}),
    },
    "relief, two places": {"model": "relief", **net(relief={"places": 2})},
    "relief without hints": {"model": "relief", **net(relief={"hints": False}, oversampling=1)},
    "relief without gate": {
        "model": "relief",
        **net(relief={"gate": False, "frame": False}, output_channels=6),
    },
    "encoded": net(encoding={"position": 4, "direction": 2, "direction_pi": False, **FILTERED}),
}


def make(case: str, folder: Path, contrast: float = 1.0) -> Material:
    generator, lattice = torch.Generator().manual_seed(0), Lattice(4, 0.5)
    options = {"finest": 4, "aspect": 0.5, "contrast": contrast, **CASES[case]}
    if case.startswith("calibrated"):
        calibration = 0.7 + 0.6 * torch.rand((2, 5, 6, 3), generator=generator)
        options["weights"] = {"calibration": calibration}
    if case == "with holes":
        shapes = [(*lattice.shape(s), 6) for s in range(5)]
        coefficients = [0.3 + 0.2 * torch.randn(s, generator=generator).numpy() for s in shapes]
        options["transmittance"] = Transmittance(lattice, coefficients)
    return write_material(folder, **options)


class Reader:
    """Evaluates ``layers.json`` and ``textures.exr`` in NumPy, by what they say."""

    def __init__(self, folder: Path) -> None:
        import OpenEXR

        self.document = json.loads((folder / "layers.json").read_text())
        self.textures: dict[str, F64] = {}
        described = self.document["textures"]
        with OpenEXR.File(str(folder / described["file"]), separate_channels=True) as file:
            for part in file.parts:
                assert list(part.channels) == described["parts"][part.name()]["channels"]
                planes = [np.array(c.pixels, np.float64) for c in part.channels.values()]
                self.textures[part.name()] = np.stack(planes, -1)
        assert {n: list(t.shape) for n, t in self.textures.items()} == {
            n: d["shape"] for n, d in described["parts"].items()
        }
        self.weights = {
            layer["name"]: (np.array(layer["weight"]), np.array(layer["bias"]), layer["activation"])
            for layers in self.document["networks"].values()
            for layer in layers
        }

    def texture(self, name: str, at: F64) -> F64:
        return bilinear(self.textures[name], at)

    def layer(self, name: str, x: F64) -> F64:
        weight, bias, activation = self.weights[name]
        if weight.ndim == 4 and weight.shape[2] > 1:
            window = np.lib.stride_tricks.sliding_window_view(x, weight.shape[2:], axis=(1, 2))
            y = np.einsum("nrcixy,oixy->nrco", window, weight, optimize=True) + bias
        else:
            y = x @ weight.reshape(weight.shape[:2]).T + bias
        functions = {"relu": lambda v: np.maximum(v, 0), "sine": np.sin, "none": lambda v: v}
        functions["leaky-relu"] = lambda v: np.where(v > 0, v, 0.01 * v)
        return np.asarray(functions[activation](y))

    def network(self, name: str, x: F64) -> F64:
        for layer in self.document["networks"][name]:
            x = self.layer(layer["name"], x)
        return x

    def encoded(self, p: F64, kind: str, options: dict[str, Any], spread: F64 | None = None) -> F64:
        if not options[kind]:
            return p
        doubling = 2.0 ** np.arange(options[kind])
        frequency = doubling * (np.pi if options["pi" if kind == "position" else "direction_pi"] else 1)
        angle = (p[..., None] * frequency).reshape(*p.shape[:-1], -1)
        left: Any = np.tile(1 / doubling, p.shape[-1]) if options["band_attenuation"] else 1.0
        if spread is not None:
            left = left * np.exp(-((spread[..., None] * frequency) ** 2) / 2).reshape(*spread.shape[:-1], -1)
        parts = [left * np.sin(angle), left * np.cos(angle)]
        return np.concatenate([*([p] if options["raw"] else []), *parts], -1)

    def value(self, options: dict[str, Any]) -> F64:
        document, encoding = self.document, options["encoding"]
        finest, shapes = document["levels"]["finest"], np.array(document["levels"]["shapes"])
        u, sigma, omega_i, omega_o = (
            np.array(document["conformance"][k]) for k in ("u", "sigma", "omega_i", "omega_o")
        )
        level = np.clip(-np.log2(2 * sigma), 0, finest)
        inception = options["decoder"] == "inception"
        steps = np.arange(-4, 5) if inception else np.zeros(1)
        nearest = shapes[np.floor(level + 0.5).astype(int)]
        places = np.empty((len(u), len(steps), len(steps), 2))
        places[..., 0] = u[:, 0, None, None] + steps[None, None, :] / nearest[:, 1, None, None]
        places[..., 1] = u[:, 1, None, None] - steps[None, :, None] / nearest[:, 0, None, None]
        view = np.broadcast_to(omega_o[:, None, None], (*places.shape[:3], 3))
        moved = places
        if options["offset"] != "none":
            seen = np.concatenate([self.texture("offset_texture.0", places), view[..., :2]], -1)
            r = 0.1 * self.network("offset_network", seen)
            along = view[..., :2] / np.maximum(view[..., 2:], 0.6) if options["offset"] == "depth" else 1.0
            moved = places + r * along / [1, document["tile"]["aspect"]]
        hints: F64 | None = None
        if "depth_weights" in document:
            surface = WrittenSurface(
                self.textures,
                document["surface.light_width"],
                document["surface.dielectric"],
                document["tile"]["aspect"],
                finest,
            )
            z, hints = surface.hints(u, level, omega_i, omega_o, options["relief"]["places"])
            weight = np.interp(level, np.arange(finest + 1), document["depth_weights"])
            step = (weight * z / omega_o[:, 2])[:, None] * omega_o[:, :2] / [1, surface.aspect]
            moved = places + step[:, None, None]
        low = np.floor(level).astype(int)
        fine = (level - low)[:, None, None, None]
        levels = np.stack([self.texture(f"pyramid.{s}", moved) for s in range(finest + 1)])
        n = np.arange(len(u))
        one, two = levels[low, n], levels[np.minimum(low + 1, finest), n]
        if options["blending"] == "blend":
            features = (1 - fine) * one + fine * two
        else:
            odd = (low % 2 == 1)[:, None, None, None]
            one, two = (1 - fine) * one, fine * two
            features = np.concatenate([np.where(odd, two, one), np.where(odd, one, two)], -1)
        if encoding["position"]:
            p = 2 * (places - np.floor(places)) - 1
            spread = 2.0 ** -level[:, None, None, None] / [1, document["tile"]["aspect"]]
            encoded = self.encoded(
                p, "position", encoding, spread if encoding["footprint_filtered"] else None
            )
            features = np.concatenate([features, encoded], -1)
        size = 3 if encoding["direction_xyz"] else 2
        lights = [self.encoded(o[:, :size], "direction", encoding) for o in (omega_i, omega_o)]
        if encoding["half_vector"]:
            half = omega_i + omega_o
            half /= np.linalg.norm(half, axis=1, keepdims=True)
            lights += [half, rotate(half, omega_i)]
        if hints is not None:
            lights += self.known_inputs(hints, omega_i, omega_o, options["relief"])
        shared = np.concatenate(lights, -1)[:, None, None]
        x = np.concatenate([features, np.broadcast_to(shared, (*features.shape[:3], shared.shape[-1]))], -1)
        x = self.inception(x) if inception else self.network("decoder", x)
        x = x[:, 0, 0]
        if hints is None or not options["relief"]["gate"]:
            value = self.output(x, options)
        else:
            gated = 2 / (1 + np.exp(-x[:, -1:])) * hints[:, 3:]
            value = self.output(x[:, :-1], options) + gated
        return np.maximum(value, 0) * self.calibration(level, omega_i, omega_o)

    def known_inputs(self, hints: F64, omega_i: F64, omega_o: F64, options: dict[str, Any]) -> list[F64]:
        e, slope, core = hints[:, :1], hints[:, 1:3], hints[:, 3:]
        out = []
        if options["hints"]:
            out += [np.log(1 + 4 * e), slope, np.log(1 + core / self.document["unit"])]
        if options["frame"]:
            normal = np.concatenate([slope, np.sqrt(1 - (slope**2).sum(1, keepdims=True))], 1)
            out += [rotate(normal, omega_i), rotate(normal, omega_o)]
        return out

    def calibration(self, level: F64, omega_i: F64, omega_o: F64) -> F64:
        total = np.ones((len(level), 3))
        for table, omega in zip(self.document.get("calibration", []), (omega_i, omega_o), strict=False):
            knots = np.array(table)
            cosines = np.arange(knots.shape[1]) / (knots.shape[1] - 1)
            low = np.minimum(np.floor(level).astype(int), len(knots) - 2)
            for c in range(3):
                at = np.stack([np.interp(omega[:, 2], cosines, row[:, c]) for row in knots])
                n, fine = np.arange(len(level)), level - low
                total[:, c] *= (1 - fine) * at[low, n] + fine * at[low + 1, n]
        return total

    def transmittance(self) -> F64:
        finest, known = self.document["levels"]["finest"], self.document["conformance"]
        u, sigma, omega_o = (np.array(known[k]) for k in ("u", "sigma", "omega_o"))
        level = np.clip(-np.log2(2 * sigma), 0, finest)
        low = np.minimum(np.floor(level).astype(int), finest - 1)
        n, fine = np.arange(len(u)), (level - low)[:, None]
        levels = np.stack([self.texture(f"transmittance.{s}", u) for s in range(finest + 1)])
        c = (1 - fine) * levels[low, n] + fine * levels[low + 1, n]
        x, y = omega_o[:, 0], omega_o[:, 1]
        return np.asarray(np.clip((c * np.stack([x**0, x, y, x * x, x * y, y * y], -1)).sum(-1), 0, 1))

    def inception(self, x: F64) -> F64:
        x = self.layer("decoder.first", x)
        for k in range(2):
            name = f"decoder.{k}"
            window = np.lib.stride_tricks.sliding_window_view(x, (3, 3), axis=(1, 2)).max((-1, -2))
            branches = [
                self.layer(f"{name}.one", x)[:, 2:-2, 2:-2],
                self.layer(f"{name}.three", self.layer(f"{name}.before3", x))[:, 1:-1, 1:-1],
                self.layer(f"{name}.five", self.layer(f"{name}.before5", x)),
                self.layer(f"{name}.pooled", window)[:, 1:-1, 1:-1],
            ]
            x = np.concatenate(branches, -1)
        return self.layer("decoder.last", x)

    def output(self, x: F64, options: dict[str, Any]) -> F64:
        gate: Any = 1.0
        if options["output_channels"] == 6:
            gate = 0.1 + 1 / (1 + np.exp(-x[:, 3:]))
            y, b, r = x[:, 0], x[:, 1], x[:, 2]
            x = np.stack([y + 1.13983 * r, y - 0.39465 * b - 0.5806 * r, y + 2.03211 * b], -1)
        value = {
            "expm1": np.expm1,
            "fourth-root": lambda v: v * np.abs(v) ** 3,
            "softplus": lambda v: np.log1p(np.exp(v)),
        }[options["output_transform"]](x)
        return np.asarray(self.document["unit"] * value * gate)


@pytest.mark.parametrize("half", [False, True], ids=["single", "half"])
@pytest.mark.parametrize("case", CASES)
def test_an_export_is_sufficient_for_evaluation(case: str, half: bool, tmp_path: Path) -> None:
    """An evaluation written from the description alone, in NumPy, meets the conformance values."""
    material = make(case, tmp_path)
    written = to_half(material)[0] if half else material
    write_textures(written, tmp_path / "textures.exr", half=half)
    write_layers(written, tmp_path / "layers.json", half=half)
    reader = Reader(tmp_path)
    assert reader.document["precision"] == ("float16" if half else "float32")
    expected = np.array(reader.document["conformance"]["rgb"])
    assert expected.std() > 0.005
    found = reader.value(material.config.network.model_dump())
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-5)
    assert (expected.astype(np.float32) == material.conformance["rgb"]).all() != half
    assert ("calibration" in reader.document["formula"]) == case.startswith("calibrated")
    assert ("transmittance" in reader.document) == (case == "with holes")
    if case == "with holes":
        assert reader.document["textures"]["parts"]["transmittance.4"]["channels"][0] == "c0"
        through = np.array(reader.document["conformance"]["transmittance"])
        assert through.std() > 0.1
        np.testing.assert_allclose(reader.transmittance(), through, atol=2e-5)
        queries = (material.conformance[k] for k in ("u", "sigma", "omega_o"))
        assert material.transmittance is not None
        assert (material.transmittance.evaluate(*queries) == through.astype(np.float32)).all() != half


def test_half_precision_states_its_error(tmp_path: Path) -> None:
    material = make("neumip", tmp_path)
    rounded, error = to_half(material)
    difference = rounded.conformance["rgb"] - material.conformance["rgb"]
    assert error.largest == pytest.approx(np.abs(difference).max(), rel=1e-5)
    assert error.rms == pytest.approx(np.sqrt((difference**2).mean()), rel=1e-4)
    assert error.relative is not None
    assert 1e-5 < error.relative < 1e-2
    assert rounded.deviation() < 1e-6
    for tensor in rounded.model.weights().values():
        assert tensor.ndim == 0 or torch.equal(tensor, tensor.half().float())
    assert f"{error.rms:.2g} 1/sr" in str(error)


def test_a_material_in_half_precision_loads_like_any_other(tmp_path: Path) -> None:
    material = make("hierarchical", tmp_path / "single")
    rounded, error = to_half(material)
    (tmp_path / "half").mkdir()
    training = material.description["training"]
    export(rounded.model, rounded.config, tmp_path / "half", data={}, training=training, half=True)
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
        to_half(make("neumip", tmp_path, contrast=1e5))


def test_formulas_of_relief_name_all_parts(tmp_path: Path) -> None:
    """The gated core is part of what is calibrated, and the gate is no color."""
    formula = make("calibrated relief", tmp_path / "all").model.formula()
    assert formula["value"] == "calibration * (own + 2 / (1 + exp(-g)) * core)"
    assert formula["own"] == "unit * (exp(x) - 1)"
    assert "log(1 + core / unit)" in formula["x"]
    assert formula["x"].endswith(" without its last output, g")
    none = make("relief without gate", tmp_path / "none").model.formula()
    assert "core *" not in none["value"]
    assert "own" not in none
    assert (
        write_material(tmp_path / "black", model="relief", weights={"unit": torch.zeros(())}).model.formula()[
            "value"
        ]
        == "0"
    )
