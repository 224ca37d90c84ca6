"""The plugin's evaluator gives the values of the PyTorch model, for every option, level, seam and shape."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
import torch
from safetensors.numpy import load_file
from support.fit_data import random_queries
from support.fuzzing import check_message
from support.known_surfaces import rough_heights
from support.material_cases import ALL, HIERARCHICAL, make
from support.plugin_materials import deviation, replace_tensors, write_material
from support.scenes import mi

from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import InputError
from mbtf_fit.material.material import Material
from mbtf_fit.surface.heightfield import HeightfieldTracer
from mbtf_fit.training.sampler import LightMixture, sampler_inputs

assert mi.variant()

from mbtf_fit.backends.mitsuba import network  # noqa: E402
from mbtf_fit.backends.mitsuba.evaluator import Evaluator  # noqa: E402
from mbtf_fit.backends.mitsuba.stored_material import read_material  # noqa: E402

RANDOM = torch.Generator().manual_seed(1)


def tensor(heights: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(heights[..., None])


SHAPES: dict[str, dict[str, Any]] = {
    "tall tile": {"case": "neumip", "aspect": 2.3},
    "flat tile": {"case": "neumip", "aspect": 0.1},
    "tall surface": {"case": "relief", "aspect": 2.3},
    **{f"one texel, {case}": {"case": case, "finest": 0} for case in ("neumip", "relief", "calibrated")},
    "one texel, four levels": {"case": "four levels, softplus", "finest": 0},
}
SHAPES |= {case: {"case": case} for case in ALL.keys() - HIERARCHICAL.keys()}
UNROLLED = ("neumip", "relief")


@pytest.mark.parametrize("name", sorted(SHAPES))
def test_conformance_and_random_queries(name: str, tmp_path: Path) -> None:
    material = make(folder=tmp_path / "material", **SHAPES[name])
    # Unrolled kernels take a second to compile.
    networks = "unrolled" if name in UNROLLED else "cooperative"
    plugin = Evaluator(read_material(tmp_path / "material"), networks)
    stored = material.conformance
    known = [stored[k] for k in ("u", "sigma", "omega_i", "omega_o")]
    assert (stored["rgb"].std() > 0.005) == (name != "black")
    if name == "black":
        assert not plugin.evaluate(*known).any()
        return
    assert deviation(plugin.evaluate(*known), stored["rgb"]) < 1e-4
    queries = random_queries(np.random.default_rng(3), 4000, Lattice(material.lattice.finest))
    queries["u"] = 5 * queries["u"] - 2
    queries["sigma"] *= np.float32(1.5)
    found, wanted = plugin.evaluate(*queries.values()), material.evaluate(*queries.values())
    # Light that passes below a surface weakens within 0.003, which magnifies the rounding of heights.
    assert deviation(found, wanted) < (1e-3 if name == "shadow rays under a coat" else 1e-4)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"finest": 6, "contrast": 0.5},
        {"model": "neumip-baseline", "finest": 6, "contrast": 1.0},
        {"model": "relief", "finest": 6},
    ],
)
def test_half_precision_errs_by_less_than_one_percent(options: dict[str, Any], tmp_path: Path) -> None:
    """Also where neighboring texels differ much, so that an offset's rounding would show."""
    material = write_material(tmp_path, **options)
    half = Evaluator(read_material(tmp_path), "half")
    queries = random_queries(np.random.default_rng(4), 20_000, material.lattice)
    assert 1e-5 < deviation(half.evaluate(*queries.values()), material.evaluate(*queries.values())) < 1e-2


@pytest.mark.parametrize("cosine", [0.3, 1e-2, 1e-4])
@pytest.mark.parametrize("columns", [12, 16])
def test_lines_that_pass_many_tiles_end_as_in_the_fit(columns: int, cosine: float, tmp_path: Path) -> None:
    """The surface is so deep that the lowest ones reach the cap on crossings: against PyTorch and the cap."""
    heights = rough_heights(8, columns, depth=3.0)
    write_material(tmp_path, model="relief", aspect=0.75, weights={"surface.heights": tensor(heights)})
    plugin = Evaluator(read_material(tmp_path), "cooperative")
    random = np.random.default_rng(6)
    angle, sine = 2 * np.pi * random.random(500), np.sqrt(1 - cosine**2)
    view = np.stack([sine * np.cos(angle), sine * np.sin(angle), np.full(500, cosine)], -1)
    u, view = (a.astype(np.float32) for a in (3 * random.random((500, 2)) - 1, view))
    found = np.array(plugin.stage1(mi.Point2f(u.T), mi.Float(0.0), mi.Vector3f(view.T))["z"][0])
    wanted = HeightfieldTracer(heights, 0.75).trace(torch.from_numpy(u), torch.from_numpy(view)).numpy()
    difference = np.abs(found - wanted)
    # A line that just misses an edge in one of them meets it in the other.
    assert np.quantile(difference, 0.98) < 1e-4
    if cosine < 1e-3:
        # Nearly all end at a border of the grid, which begins at the first texel's center, after 64 others.
        borders = -found / cosine * (np.abs(view[:, 0]) + np.abs(view[:, 1]) / 0.75)
        capped = borders > 63
        assert capped.mean() > 0.9
        assert borders.max() < 67
        end = u + (found / cosine)[:, None] * view[:, :2] / [1, 0.75] - 0.5 / np.array([columns, 8])
        assert np.quantile(np.abs(end - np.round(end)).min(1)[capped], 0.98) < 1e-3


def test_vertical_light_has_the_azimuth_0(tmp_path: Path) -> None:
    """Whatever the signs of its zeros; in deep surfaces, whose horizons reach the zenith."""
    horizons = 0.5 + torch.rand((8, 8, 16), generator=RANDOM)
    both = torch.cat([horizons, horizons.square() + 0.1], -1)
    material = write_material(tmp_path, model="relief", weights={"surface.horizons.3": both})
    plugin = Evaluator(read_material(tmp_path), "cooperative")
    n = 100
    queries = random_queries(np.random.default_rng(8), n, material.lattice)
    queries["sigma"][:] = 2.0**-4
    level, found, visible = torch.full((n,), 3.0), [], []
    for x, y in ((1e-12, 0.0), (0.0, 0.0), (-0.0, 0.0), (0.0, -0.0), (-0.0, -0.0)):
        queries["omega_i"] = np.tile(np.float32([x, y, 1.0]), (n, 1))
        u, light = (torch.from_numpy(queries[name]) for name in ("u", "omega_i"))
        found += [plugin.evaluate(*queries.values()), material.evaluate(*queries.values())]
        assert material.model.tracing is not None
        shade = material.model.tracing[1]
        visible.append(material.model.known.visibility(shade, u, None, level, light).numpy())
    assert np.ptp(visible[0]) > 0.2
    for shares in visible[1:]:
        np.testing.assert_allclose(shares, visible[0], atol=1e-6)
    for values in found[1:]:
        assert deviation(values, found[0]) < 1e-4


def test_half_precision_does_not_round_inputs() -> None:
    """A difference of 2⁻¹², which half precision cannot hold beside 1, is seen by the first layer."""
    one = np.ones((1, 1), np.float32)
    layers = [(one, np.full(1, -1.0, np.float32)), (4096 * one, np.zeros(1, np.float32))]
    (found,) = network.PackedNetwork(layers, "half")([mi.Float(1.0 + 2.0**-12)])
    assert found[0] == 1.0


def test_an_operation_of_pytorch_alone_is_refused(tmp_path: Path) -> None:
    write_material(tmp_path, model="hierarchical")
    with pytest.raises(InputError, match="plugin does not support the operation 'neighborhood'") as caught:
        Evaluator(read_material(tmp_path))
    check_message(caught.value)
    assert "mbtf-fit evaluate" in caught.value.hint


@pytest.mark.parametrize("wide", range(4))
def test_one_lane_stands_for_all(wide: int, tmp_path: Path) -> None:
    """Position, level, view or light alone has many lanes: a schedule of several sizes ends the process."""
    write_material(tmp_path, model="relief")
    plugin = Evaluator(read_material(tmp_path), "cooperative")
    at, n = [[0.3, 0.6], [1.37], [0.48, 0.36, 0.8], [0.6, 0.0, 0.8]], 8
    lanes = [[dr.opaque(mi.Float, x, n if k == wide else 1) for x in v] for k, v in enumerate(at)]
    u, omega_o, omega_i = mi.Point2f(lanes[0]), mi.Vector3f(lanes[2]), mi.Vector3f(lanes[3])
    found = np.array(plugin.value(plugin.stage1(u, lanes[1][0], omega_o), omega_i)).T
    query = (np.array([x], np.float32) for x in (at[0], 0.5 * 2.0**-1.37, at[3], at[2]))
    wanted = Material.load(tmp_path).evaluate(*query)
    np.testing.assert_allclose(found, np.tile(wanted, (n, 1)), rtol=1e-3)


@pytest.mark.parametrize("model", ["neumip", "relief"])
def test_the_plugin_has_the_mixtures_of_pytorch(model: str, tmp_path: Path) -> None:
    """Also where a surface of random maps varies with position and level; no gradients through them, which
    would be biased."""
    stored = write_material(tmp_path, model=model, sampled=True, contrast=1.0)
    sampler = stored.sampler
    assert sampler is not None
    plugin = Evaluator(read_material(tmp_path), "cooperative")
    u, sigma, _, view = random_queries(np.random.default_rng(2), 300, stored.lattice).values()
    inputs = sampler_inputs(stored.model, sampler.operations, u, sigma, view)
    layers = [sampler.tensors[f"sampler.{k}.{n}"] for k in range(3) for n in ("weight", "bias")]
    x = inputs
    for k, (weight, bias) in enumerate(zip(layers[::2], layers[1::2], strict=True)):
        x = torch.nn.functional.linear(x, weight, bias)
        x = x.relu() if k < 2 else x
    wanted = LightMixture.of(x)
    level = np.clip(-np.log2(2 * sigma), 0, stored.lattice.finest)
    omega = mi.Vector3f(view.T)
    values = plugin.stage1(mi.Point2f(u.T), mi.Float(level), omega)
    found = plugin.mixture(values, omega)
    for name in ("l11", "l21", "l22", "x", "y"):
        expected = getattr(wanted, name)[:, 0].detach()
        np.testing.assert_allclose(np.array(getattr(found.lobe, name)), expected, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(np.array(found.weight), wanted.weight[:, 0].detach(), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(
    ("options", "place", "changes", "fault"),
    [
        ({}, "network", {"hidden": [24, 25, 25]}, "has the shape"),
        ({}, "lookup", {"channels": 6}, "has the shape"),
        ({"sampled": True}, "sampler", {"x": ["omega_i"]}, "is not that of its operations"),
        ({"sampled": True}, "sampler.1.bias", None, "sampler.1.bias"),
        ({"model": "relief"}, "surface.heights", lambda a: a[:0], "is empty"),
        ({"model": "relief"}, "surface.heights", lambda a: a + 0.01, "has heights above the reference plane"),
        ({"model": "relief"}, "surface.maps.3", None, "lacks the tensor 'surface.maps.3'"),
        ({"model": "relief"}, "surface.maps.0", lambda a: a[..., :9], "have 9 channels in place of 8, 10"),
        ({"model": "relief"}, "surface.dielectric", lambda a: a[None], "has the shape (1,)"),
    ],
)
def test_operations_and_tensors_that_do_not_fit_are_refused(
    options: dict[str, Any], place: str, changes: Any, fault: str, tmp_path: Path
) -> None:
    """Changed fields of an operation or of the sampler's network; a tensor that is changed or missing. What
    no reader takes is that of test_fuzz_fits.py."""
    write_material(tmp_path, **options)
    path = tmp_path / "material.json"
    description = json.loads(path.read_text())
    if isinstance(changes, dict):
        key, kind = ("sampler", "network") if place == "sampler" else ("operations", place)
        next(op for op in description[key] if op["operation"] == kind).update(changes)
        path.write_text(json.dumps(description))
    else:
        tensor = load_file(tmp_path / "weights.safetensors")[place]
        replace_tensors(tmp_path, {place: None if changes is None else changes(tensor)})
    readers = [lambda: Evaluator(read_material(tmp_path))]
    readers += [lambda: Material.load(tmp_path)] if "sampled" in options else []
    for read in readers:
        with pytest.raises(InputError, match=re.escape(fault)) as caught:
            read()
        check_message(caught.value)
