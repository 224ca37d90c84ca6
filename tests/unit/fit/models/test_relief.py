"""The model that traces the known heights: kernel, stages, files, and refusals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from support.fit_data import random_queries
from support.fuzzing import check_message
from support.known_surfaces import rough_surface
from support.traced_gradients import assert_gradients_agree, needs_kernel, traced_batch
from torch import Tensor

from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import InputError
from mbtf_fit.backends.cpu.pattern import match
from mbtf_fit.config import build_model
from mbtf_fit.material.inference import predict
from mbtf_fit.ops import Shade
from mbtf_fit.ops.operation import sizes_of
from mbtf_fit.pytorch.material import NeuralMaterial
from mbtf_fit.pytorch.operations import rotate_to_z

LATTICE = Lattice(3, 0.5)
VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "four places, no frame": {"relief": {"frame": False, "places": 4}},
    "tracing alone": {
        "relief": {"hints": False, "gate": False, "frame": False},
        "encoding": {"half_vector": False},
        "oversampling": 1,
    },
    "no gate": {"relief": {"gate": False}},
    "no hints": {"relief": {"hints": False}},
    "wide": {"width": 31, "channels": 11, "layers": 3, "encoding": {"direction_xyz": False}},
    "shadow rays": {"relief": {"places": 2, "shadow_rays": True}},
    "cloth": {"relief": {"places": 2, "shadow_rays": True}},
    "cloth without frame": {"relief": {"frame": False, "gate": False}},
}


def model_of(name: str) -> NeuralMaterial:
    """A model with random parameters on a rough surface."""
    model = build_model("cloth" if "cloth" in name else "relief", LATTICE, **VARIANTS[name])
    model.know(rough_surface(LATTICE))
    generator = torch.Generator().manual_seed(0)
    model.initialize(generator, 0.1)
    with torch.no_grad():
        for p in model.parameters():
            p += 0.1 * torch.randn(p.shape, generator=generator)
    return model


@needs_kernel
@pytest.mark.parametrize("name", VARIANTS)
def test_kernel_and_pytorch_agree(name: str) -> None:
    model = model_of(name)
    batch = traced_batch(model)
    arrays = (batch.u, batch.sigma, batch.omega_i, batch.omega_o)
    wanted = model(*arrays, batch.hints).clamp_min(0).detach().numpy()
    np.testing.assert_allclose(predict(model, *arrays), wanted, atol=1e-5, rtol=1e-5)
    assert_gradients_agree(model, batch)


def test_the_difference_vector_is_the_light_about_the_half_vector() -> None:
    random = np.random.default_rng(0)
    arrays = random_queries(random, 100, LATTICE)
    light, view = (torch.from_numpy(arrays[k]) for k in ("omega_i", "omega_o"))
    model = build_model("relief", LATTICE)
    half, difference = model.run(["half", "difference"], {"omega_i": light, "omega_o": view})
    torch.testing.assert_close(half, torch.nn.functional.normalize(light + view, dim=1))
    up = torch.tensor([0.0, 0.0, 1.0]).expand_as(half)
    # Rodrigues' rotation about the horizontal axis h × z.
    axis = torch.nn.functional.normalize(torch.linalg.cross(half, up), dim=1)
    c = half[:, 2:]
    s = (1 - c * c).sqrt()
    along = (axis * light).sum(1, keepdim=True)
    wanted = light * c + torch.linalg.cross(axis, light) * s + axis * along * (1 - c)
    torch.testing.assert_close(difference, wanted, atol=2e-5, rtol=1e-4)
    torch.testing.assert_close(rotate_to_z(half, half), up, atol=1e-5, rtol=0)
    # The view lies opposite, whichever of both is the light.
    (opposite,) = model.run(["difference"], {"omega_i": view, "omega_o": light})
    opposite = opposite * torch.tensor([-1.0, -1.0, 1.0])
    torch.testing.assert_close(opposite, difference, atol=2e-5, rtol=1e-4)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("surface.heights", lambda t: t[:0]),
        ("surface.heights", lambda t: t + 0.01),
        ("surface.heights", lambda t: torch.where(t == t.min(), torch.nan, t)),
        ("surface.maps.0", lambda t: t.repeat(1, 1, 4)),
        ("surface.horizons.3", lambda t: t[:, :-1]),
        ("surface.light_width", lambda t: t[None]),
        ("depth_weights", lambda t: t[1:]),
    ],
)
def test_tensors_of_other_shapes_are_refused(name: str, change: Callable[[Tensor], Tensor]) -> None:
    """Also heights above the reference plane, and such as are no numbers."""
    tensors = model_of("default").weights()
    with pytest.raises(InputError, match=f"do not fit the model relief: '{name}'") as caught:
        build_model("relief", LATTICE).load_weights({**tensors, name: change(tensors[name])})
    check_message(caught.value)


def test_cloth_without_its_fibers_is_refused() -> None:
    tensors = {k: t for k, t in model_of("cloth").weights().items() if not k.startswith("surface.fibers")}
    with pytest.raises(InputError, match=r"do not fit the model cloth: 'surface\.fibers\.0'"):
        build_model("cloth", LATTICE, **VARIANTS["cloth"]).load_weights(tensors)


@pytest.mark.parametrize(("name", "reads"), [("cloth", True), ("default", False)])
def test_cloth_reads_the_height_of_the_intersection(name: str, reads: bool) -> None:
    """Besides the displacement of the lookup by it, which is off here."""
    model = model_of(name)
    with torch.no_grad():
        model.number("depth_weights").zero_()
    batch = traced_batch(model)
    deeper = batch.hints.clone()
    deeper[:, 0] -= 0.05
    arrays = (batch.u, batch.sigma, batch.omega_i, batch.omega_o)
    assert bool((model(*arrays, batch.hints) != model(*arrays, deeper)).any()) == reads


@pytest.mark.parametrize("name", ["depth", "log_irradiance", "log_core"])
def test_the_kernel_does_not_take_inputs_with_a_bound(name: str) -> None:
    """It knows none of them."""
    operations = model_of("cloth").operations
    assert match(operations) is not None
    assert match([replace(op, most="most") if op.output == name else op for op in operations]) is None


def shade_of(model: NeuralMaterial) -> Shade:
    assert model.tracing is not None
    return model.tracing[1]


def test_light_comes_further_between_fibers() -> None:
    cloth, stone = (shade_of(model_of(name)).light_depth for name in ("cloth", "shadow rays"))
    assert cloth > 5 * stone


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"heights": None}, "needs both depths and heights"),
        ({"depths": "z"}, "needs one depth per place"),
        ({"light_depth": 0.0}, "has light_depth 0, not above 0"),
    ],
)
def test_shadow_rays_ask_for_depths_and_heights(change: dict[str, Any], message: str) -> None:
    operations = model_of("shadow rays").operations
    changed = [replace(op, **change) if isinstance(op, Shade) else op for op in operations]
    with pytest.raises(ValueError, match=message):
        sizes_of(changed)
    assert match(operations) is not None
    other = [replace(op, heights="other") if isinstance(op, Shade) else op for op in operations]
    assert match(other) is None
