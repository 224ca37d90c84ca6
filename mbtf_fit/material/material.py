"""The fitted material: its folder, which renderers read, and its evaluation."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from mbtf_core.data.lattice import Lattice, sigma_of_level
from mbtf_core.data.schema import CONVENTIONS
from mbtf_core.directions import check_unit, from_projected_disk
from mbtf_core.errors import InputError, check_type, reason
from mbtf_core.files.atomic import write_json
from mbtf_fit.config import FitConfig, stored_config
from mbtf_fit.data.queries import ShardQueries
from mbtf_fit.material.format import (
    AGAIN,
    CONFORMANCE_COUNT,
    DESCRIPTION_NAME,
    FORMAT_NAME,
    MATERIAL_CONVENTIONS,
    QUERY,
    SCHEMA_VERSION,
    WEIGHTS_NAME,
    check_conformance,
    lattice_of,
    read_description,
    read_weights,
    write_tensors,
)
from mbtf_fit.material.inference import evaluate_in_chunks, predict
from mbtf_fit.material.sampler import Sampler, is_of_sampler
from mbtf_fit.material.texture_formats import QUANTIZED, RANGE, TextureFormat, encode, grouped
from mbtf_fit.material.transmittance import (
    TRANSMITTANCE_NAME,
    Transmittance,
    read_transmittance,
    write_transmittance,
)
from mbtf_fit.ops import read_operations
from mbtf_fit.ops.operation import SAMPLER
from mbtf_fit.pytorch.material import NeuralMaterial


def conformance_queries(lattice: Lattice) -> dict[str, NDArray[np.float32]]:
    """Conformance queries of a lattice; they include seams and the first and last level."""
    random = np.random.Generator(np.random.Philox(key=[0x636F6E66, lattice.finest]))
    u = random.random((CONFORMANCE_COUNT, 2))
    u[:8, 0] = [0, 0, 0.5, 0.999, 0.001, 0.5, 0.25, 0.75]
    u[:8, 1] = [0, 0.5, 0, 0.999, 0.999, 0.5, 0.75, 0.25]
    level = random.random(CONFORMANCE_COUNT) * lattice.finest
    level[8:12] = [0, lattice.finest, -1, lattice.finest + 1]
    level[12:16] = np.floor(level[12:16])
    disk = np.sqrt(0.99 * random.random((2, CONFORMANCE_COUNT)))
    angle = 2 * np.pi * random.random((2, CONFORMANCE_COUNT))
    disk[:, 16] = 0
    omega = from_projected_disk(np.stack([disk * np.cos(angle), disk * np.sin(angle)], -1))
    arrays = {"u": u, "sigma": sigma_of_level(level), "omega_i": omega[0], "omega_o": omega[1]}
    return {name: np.ascontiguousarray(array, np.float32) for name, array in arrays.items()}


def _numbers(values: ArrayLike, name: str) -> NDArray[np.float32]:
    try:
        array = np.asarray(values)
        if array.dtype.kind not in "biuf":
            raise TypeError(f"its type is {array.dtype}")
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"is no array of real numbers ({reason(error)})", where=name) from None
    with np.errstate(over="ignore"):
        found = np.asarray(array, np.float32)
    # An infinite footprint is that of the coarsest level.
    wrong = np.isnan(found) if name == "sigma" else ~np.isfinite(found)
    if bad := int(wrong.sum()):
        raise InputError(f"holds NaN or infinity ({bad} of {found.size} numbers)", where=name)
    if name == "sigma" and (bad := int((found < 0).sum())):
        raise InputError(f"is negative ({bad} of {found.size} numbers)", where=name)
    return found


def _broadcast(
    inputs: Mapping[str, tuple[ArrayLike, int]],
) -> tuple[tuple[int, ...], list[NDArray[np.float32]]]:
    """Common leading axes of inputs, and each with a single one.

    Parameters
    ----------
    inputs : name → (values, size of its last axis, which leads nothing; 0 for numbers)

    Raises
    ------
    InputError : not numbers, NaN or infinity; a last axis has another size, or the others do not broadcast
    """
    arrays = [_numbers(values, name) for name, (values, _) in inputs.items()]
    own = [(size,) * (size > 0) for _, size in inputs.values()]
    leads = [a.shape[: a.ndim - len(axis)] for a, axis in zip(arrays, own, strict=True)]
    try:
        lead = np.broadcast_shapes(*leads)
        full = [np.broadcast_to(a, (*lead, *axis)) for a, axis in zip(arrays, own, strict=True)]
        if any(a.shape[-len(axis) :] != axis for a, axis in zip(arrays, own, strict=True) if axis):
            raise ValueError
    except ValueError:
        what = f"have the shapes {', '.join(str(a.shape) for a in arrays)}"
        wanted = ", ".join(f"(..., {axis[0]})" if axis else "(...)" for axis in own)
        raise InputError(what, where=", ".join(inputs), hint=f"they must broadcast to {wanted}") from None
    # Tensors must be writable, which arrays of files and broadcast ones are not.
    return lead, [
        np.require(a.reshape(-1, *axis), requirements=["C", "W"]) for a, axis in zip(full, own, strict=True)
    ]


@dataclass(frozen=True)
class Material:
    """A fitted material.

    Attributes
    ----------
    model : NeuralMaterial
        The model with its weights.
    config : FitConfig
        Options of the fit.
    description : dict
        Content of ``material.json``.
    conformance : dict of str to float32 array
        Conformance queries ``u`` (n, 2), ``sigma`` (n,), ``omega_i`` and ``omega_o`` (n, 3), and their
        expected values ``rgb`` (n, 3).
    transmittance : Transmittance or None
        Transparent fraction of footprints; None for an opaque material.
    sampler : Sampler or None
        Says where light matters, for importance sampling; None for the cosine.
    """

    model: NeuralMaterial
    config: FitConfig
    description: dict[str, Any]
    conformance: dict[str, NDArray[np.float32]]
    transmittance: Transmittance | None = None
    sampler: Sampler | None = None

    @classmethod
    def load(cls, folder: str | Path, device: str = "cpu") -> Material:
        """Load a material.

        Parameters
        ----------
        folder : str or Path
            Folder made by ``mbtf-fit``.
        device : str
            PyTorch device of the weights.

        Returns
        -------
        Material

        Raises
        ------
        InputError
            The folder is missing, corrupt, or of another schema.
        """
        check_type(folder, (str, os.PathLike), "material", "give the path of its folder")
        description, weights = read_description(Path(folder))
        config = stored_config(description["config"], weights.with_name(DESCRIPTION_NAME))
        lattice = lattice_of(description)
        try:
            # Without memory at first: a small file cannot ask for that of a large model.
            with torch.device("meta"):
                model = NeuralMaterial(
                    lattice, read_operations(description["operations"]), description["model"]
                )
        except (ValueError, TypeError, RuntimeError) as error:
            raise InputError(reason(error), where=weights.with_name(DESCRIPTION_NAME), hint=AGAIN) from None
        if sum(p.numel() for p in model.parameters()) > 2 * weights.stat().st_size:
            what = f"is too small for the operations and levels that {DESCRIPTION_NAME} describes"
            raise InputError(what, where=weights, hint=AGAIN)
        model.to_empty(device="cpu")
        tensors = read_weights(weights, description)
        conformance = check_conformance(tensors, description, weights)
        own = {n: t for n, t in tensors.items() if not n.startswith("conformance.") and not is_of_sampler(n)}
        model.load_weights(own)
        model.to(device).requires_grad_(False)
        try:
            sampler = Sampler.read(description, tensors, model.operations)
        except ValueError as error:
            raise InputError(reason(error), where=weights.with_name(DESCRIPTION_NAME), hint=AGAIN) from None
        transmittance = read_transmittance(Path(folder), description)
        return cls(model, config, description, conformance, transmittance, sampler)

    def __repr__(self) -> str:
        return f"<Material: {self.model.name}, resolution {self.lattice.shape()[1]}>"

    @property
    def lattice(self) -> Lattice:
        """Texel grids of the tile."""
        return self.model.lattice

    @property
    def texture_format(self) -> TextureFormat:
        """Format of the stored textures."""
        form: TextureFormat = self.description["weights"]["dtype"]
        return form

    def evaluate(
        self, u: ArrayLike, sigma: ArrayLike, omega_i: ArrayLike, omega_o: ArrayLike
    ) -> NDArray[np.float32]:
        """Values M(u, σ, ω_i, ω_o) in 1/sr, linear RGB, at least 0. The leading axes ``...`` broadcast.

        Parameters
        ----------
        u : (..., 2) float array
            Positions on the reference plane, uv; the tile repeats.
        sigma : (...) float array
            Standard deviations of the footprints in tile widths, clamped to the material's levels.
        omega_i, omega_o : (..., 3) float array
            Unit vectors towards light and viewer, z > 0.

        Returns
        -------
        (..., 3) float32 array

        Raises
        ------
        InputError
            Not finite numbers, a direction is no unit vector with z > 0, or the shapes do not broadcast.
        """
        lead, flat = _broadcast(
            {"u": (u, 2), "sigma": (sigma, 0), "omega_i": (omega_i, 3), "omega_o": (omega_o, 3)}
        )
        check_unit(omega_i, "omega_i", above=True)
        check_unit(omega_o, "omega_o", above=True)
        return predict(self.model, *flat).reshape(*lead, 3)

    def offset(self, u: ArrayLike, omega_o: ArrayLike) -> NDArray[np.float32]:
        """Evaluate the neural offset of the texture lookup. The leading axes ``...`` broadcast.

        Parameters
        ----------
        u : (..., 2) float array
            Positions on the reference plane, uv.
        omega_o : (..., 3) float array
            Unit vectors towards the viewer, z > 0.

        Returns
        -------
        (..., 2) float32 array
            Offsets along u and v in tile widths at the finest level; zero for a model without offset, or
            with one that depends on the light.

        Raises
        ------
        InputError
            Not finite numbers, a direction is no unit vector with z > 0, or the shapes do not broadcast.
        """
        device = next(self.model.parameters()).device
        lead, flat = _broadcast({"u": (u, 2), "omega_o": (omega_o, 3)})
        check_unit(omega_o, "omega_o", above=True)
        return evaluate_in_chunks(self.model.offset, device, 2, *flat).reshape(*lead, 2)

    def predict(self, queries: ShardQueries) -> NDArray[np.float32]:
        """:meth:`evaluate` at queries of a data set."""
        return self.evaluate(queries.u, queries.sigma, queries.omega_i, queries.omega_o)

    def deviation(self) -> float:
        """Largest deviation of this machine from the conformance values, in 1/sr."""
        found = self.evaluate(*(self.conformance[name] for name in QUERY))
        return float(np.abs(found - self.conformance["rgb"]).max())


def conformance_values(
    model: NeuralMaterial, queries: Mapping[str, NDArray[np.float32]]
) -> NDArray[np.float32]:
    """Expected values (n, 3) of conformance queries."""
    device = next(model.parameters()).device
    with torch.no_grad():
        rgb = model(*(torch.from_numpy(queries[name]).to(device) for name in QUERY))
    return np.asarray(rgb.clamp_min(0).cpu().numpy())


def describe_model(model: NeuralMaterial) -> dict[str, Any]:
    """Operations, conventions and shapes of a material, for readers of its tensors."""
    lattice = model.lattice
    return {
        "model": model.name,
        "operations": [op.as_json() for op in model.stored_operations()],
        "conventions": CONVENTIONS | MATERIAL_CONVENTIONS,
        "tile": {"aspect": lattice.aspect},
        "levels": {
            "finest": lattice.finest,
            "shapes": [list(lattice.shape(s)) for s in range(lattice.finest + 1)],
        },
    }


def stored_tensors(weights: dict[str, Tensor], form: TextureFormat) -> dict[str, Tensor]:
    """Tensors as a file has them, with the ranges of quantized textures."""
    if form == "float16":
        return {name: tensor.half() if tensor.ndim else tensor for name, tensor in weights.items()}
    out = dict(weights)
    for texture, names in grouped(weights).items() if form in QUANTIZED else ():
        codes, limits = encode(texture, [weights[name].cpu().numpy() for name in names], form)
        out |= {name: torch.from_numpy(code) for name, code in zip(names, codes, strict=True)}
        out[texture + RANGE] = torch.from_numpy(limits)
    return out


def export(
    model: NeuralMaterial,
    config: FitConfig,
    folder: Path,
    *,
    data: dict[str, Any],
    training: dict[str, Any],
    form: TextureFormat = "float32",
    transmittance: Transmittance | None = None,
    sampler: Sampler | None = None,
) -> Material:
    """Write a model as a material and return it as read back.

    Parameters
    ----------
    data : identity of the data set
    training : summary of the training: steps, seconds, errors
    form : of the textures, to which they are rounded already

    Raises
    ------
    PartialError : the folder cannot be written
    """
    extra: dict[str, Any] = {}
    if transmittance is not None:
        written = write_transmittance(transmittance, folder / TRANSMITTANCE_NAME)
        extra["transmittance"] = {"file": TRANSMITTANCE_NAME, "sha256": written.sha256}
    queries = conformance_queries(model.lattice)
    weights = model.weights()
    if sampler is not None:
        extra[SAMPLER] = [op.as_json() for op in sampler.operations]
        weights |= sampler.tensors
    queries["rgb"] = conformance_values(model, queries)
    conformance = {f"conformance.{k}": torch.from_numpy(v) for k, v in queries.items()}
    texels, others = model.parameter_groups()
    # The description names the weights' digest, so it comes last: a folder with one is complete.
    written = write_tensors(folder / WEIGHTS_NAME, {**stored_tensors(weights, form), **conformance}, {})
    write_json(
        folder / DESCRIPTION_NAME,
        {
            "format": FORMAT_NAME,
            "schema": SCHEMA_VERSION,
            **describe_model(model),
            "weights": {
                "file": WEIGHTS_NAME,
                "sha256": written.sha256,
                "dtype": form,
                "shapes": {name: list(tensor.shape) for name, tensor in weights.items()},
                "network_weights": sum(p.numel() for p in others),
                "texels": sum(p.numel() for p in texels),
            },
            "conformance": {
                "count": CONFORMANCE_COUNT,
                "tensors": list(conformance),
                "tolerance": 1e-4,
                "note": "evaluating the first four must give the fifth within tolerance * max(1, value)",
            },
            **extra,
            "config": config.model_dump(mode="json"),
            "data": data,
            "training": training,
        },
    )
    return Material.load(folder)
