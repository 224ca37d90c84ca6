"""The fitted material: a folder that a renderer can read, and its evaluation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, Field

from mbtf_gen.atomic import digest, read_json, write_json
from mbtf_gen.directions import from_projected_disk
from mbtf_gen.errors import InputError
from mbtf_gen.levels import MAX_LEVEL, Lattice, sigma_of_level
from mbtf_gen.schema import CONVENTIONS
from mbtf_gen.settings import build, check_document

from .config import FitConfig
from .data import Queries
from .inference import evaluate_in_chunks, predict
from .models import NeuralMaterial, build_model
from .storage import read_tensors, write_tensors

FORMAT_NAME = "mbtf-material"
SCHEMA_VERSION = 1
DESCRIPTION_NAME = "material.json"
WEIGHTS_NAME = "weights.safetensors"
# Queries with expected values that every exported material carries.
CONFORMANCE_COUNT = 256
_CONFORMANCE = ("u", "sigma", "omega_i", "omega_o", "rgb")


class _Weights(BaseModel):
    sha256: str
    network_weights: int
    texels: int


class _Levels(BaseModel):
    finest: Annotated[int, Field(strict=True, ge=0, le=MAX_LEVEL)]


class _Tile(BaseModel):
    aspect: Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)]


class _Conformance(BaseModel):
    count: int


class _Training(BaseModel):
    steps: int
    batch: int
    seconds: float
    device: str
    threads: int
    errors: dict[str, Any]


class _Description(BaseModel):
    """What readers of ``material.json`` rely on; it holds more."""

    model: str
    config: dict[str, Any]
    weights: _Weights
    levels: _Levels
    tile: _Tile
    conformance: _Conformance
    training: _Training
    data: dict[str, Any]


def conformance_queries(lattice: Lattice) -> dict[str, NDArray[np.float32]]:
    """The queries of every material of a lattice, all over its arguments; seams and end levels included."""
    random = np.random.Generator(np.random.Philox(key=[0x636F6E66, lattice.finest]))
    u = random.random((CONFORMANCE_COUNT, 2))
    seams = [
        [0, 0],
        [0, 0.5],
        [0.5, 0],
        [0.999, 0.999],
        [0.001, 0.999],
        [0.5, 0.5],
        [0.25, 0.75],
        [0.75, 0.25],
    ]
    u[:8] = np.array(seams)
    level = random.random(CONFORMANCE_COUNT) * lattice.finest
    level[8:12] = np.array([0, lattice.finest, -1, lattice.finest + 1], np.float64)
    level[12:16] = np.floor(level[12:16])
    disk = np.sqrt(0.99 * random.random((2, CONFORMANCE_COUNT)))
    angle = 2 * np.pi * random.random((2, CONFORMANCE_COUNT))
    disk[:, 16] = 0
    omega = from_projected_disk(np.stack([disk * np.cos(angle), disk * np.sin(angle)], -1))
    arrays = {"u": u, "sigma": sigma_of_level(level), "omega_i": omega[0], "omega_o": omega[1]}
    return {name: np.ascontiguousarray(array, np.float32) for name, array in arrays.items()}


@dataclass(frozen=True)
class Material:
    """A fitted material.

    Attributes
    ----------
    model : with its weights, ready to evaluate
    config : that it was fitted with
    description : content of ``material.json``
    conformance : the stored queries with their expected values ``rgb`` (n, 3)
    """

    model: NeuralMaterial
    config: FitConfig
    description: dict[str, Any]
    conformance: dict[str, NDArray[np.float32]]

    @classmethod
    def load(cls, folder: str | Path, device: str = "cpu") -> Material:
        """Load an exported material.

        Raises
        ------
        InputError : missing, damaged, or of another schema
        """
        folder = Path(folder)
        if not folder.is_dir():
            raise InputError("no such folder", where=folder)
        path = folder / DESCRIPTION_NAME
        if not path.exists():
            raise InputError(
                f"no {DESCRIPTION_NAME} in it",
                where=folder,
                cure="make a material with: mbtf-fit SHARDS -o FOLDER",
            )
        description = read_json(path)
        if description.get("format") != FORMAT_NAME:
            raise InputError(f"does not describe a material ({FORMAT_NAME})", where=path)
        if description.get("schema") != SCHEMA_VERSION:
            raise InputError(
                f"material of schema {description.get('schema')}; this version reads schema {SCHEMA_VERSION}",
                where=path,
                cure="fit it again with this version of mbtf-fit",
            )
        check_document(_Description, description, path, "fit it again, or fetch it again from where it came")
        weights = folder / WEIGHTS_NAME
        if not weights.is_file() or digest(weights) != description["weights"]["sha256"]:
            raise InputError("is missing or not the file that material.json describes", where=weights)
        config = build(FitConfig, description["config"], source=str(path))
        lattice = Lattice(description["levels"]["finest"], description["tile"]["aspect"])
        # Before memory is taken for a model that the weights cannot fill.
        if 4 * lattice.texels() * config.network.channels > weights.stat().st_size:
            raise InputError("is too small for the levels that material.json describes", where=weights)
        model = build_model(config.model, lattice, **config.network.model_dump())
        tensors, _ = read_tensors(weights, device)
        missing = [name for name in _CONFORMANCE if f"conformance.{name}" not in tensors]
        if missing:
            raise InputError(f"lacks the tensor 'conformance.{missing[0]}'", where=weights)
        conformance = {
            name: tensors.pop(f"conformance.{name}").float().cpu().numpy() for name in _CONFORMANCE
        }
        wanted = {"u": (2,), "sigma": (), "omega_i": (3,), "omega_o": (3,), "rgb": (3,)}
        for name, array in conformance.items():
            if array.shape != (description["conformance"]["count"], *wanted[name]):
                raise InputError(
                    f"its tensor 'conformance.{name}' has the shape {array.shape}", where=weights
                )
        model.to(device).requires_grad_(False)
        model.load_weights(tensors)
        return cls(model, config, description, conformance)

    @property
    def lattice(self) -> Lattice:
        """Texel grids of the tile."""
        return self.model.lattice

    def evaluate(
        self, u: ArrayLike, sigma: ArrayLike, omega_i: ArrayLike, omega_o: ArrayLike
    ) -> NDArray[np.float32]:
        """Values M(u, σ, ω_i, ω_o) in 1/sr, linear RGB, at least 0.

        Parameters
        ----------
        u : (n, 2) uv, any real numbers: the tile repeats
        sigma : (n,) tile widths; outside the material's levels the nearest level answers
        omega_i, omega_o : (n, 3) unit vectors towards light and viewer, z > 0

        Returns
        -------
        (n, 3)
        """
        return predict(self.model, u, sigma, omega_i, omega_o)

    def offset(self, u: ArrayLike, omega_o: ArrayLike) -> NDArray[np.float32]:
        """By how much the material moves its lookup at `u` (n, 2) seen from `omega_o` (n, 3): (n, 2) in tile
        widths along u and v; zero for a model without offsets."""
        device = next(self.model.parameters()).device
        return evaluate_in_chunks(self.model.offset, device, 2, u, omega_o)

    def predict(self, queries: Queries) -> NDArray[np.float32]:
        """:meth:`evaluate` at queries of a data set."""
        return self.evaluate(queries.u, queries.sigma, queries.omega_i, queries.omega_o)

    def deviation(self) -> float:
        """Largest difference between the stored conformance values and what is evaluated here, in 1/sr."""
        found = self.evaluate(*(self.conformance[name] for name in _CONFORMANCE[:-1]))
        return float(np.abs(found - self.conformance["rgb"]).max())


def export(
    model: NeuralMaterial,
    config: FitConfig,
    folder: Path,
    *,
    data: dict[str, Any],
    training: dict[str, Any],
) -> Material:
    """Write a model as a material and return it as read back.

    Parameters
    ----------
    data : what identifies the data set
    training : summary of the training: steps, seconds, errors

    Raises
    ------
    PartialError : the folder cannot be written
    """
    lattice = model.lattice
    queries = conformance_queries(lattice)
    weights = model.weights()
    device = next(model.parameters()).device
    with torch.no_grad():
        rgb = model(*(torch.from_numpy(a).to(device) for a in queries.values())).clamp_min(0).cpu()
    conformance = {f"conformance.{k}": torch.from_numpy(v) for k, v in queries.items()}
    path = folder / WEIGHTS_NAME
    # The description names the weights' digest, so it comes last: a folder with one is complete.
    write_tensors(path, {**weights, **conformance, "conformance.rgb": rgb}, {})
    shape = {name: list(tensor.shape) for name, tensor in weights.items()}
    write_json(
        folder / DESCRIPTION_NAME,
        {
            "format": FORMAT_NAME,
            "schema": SCHEMA_VERSION,
            "model": model.name,
            "formula": model.formula(),
            "conventions": CONVENTIONS | _CONVENTIONS,
            "tile": {"aspect": lattice.aspect},
            "levels": {
                "finest": lattice.finest,
                "shapes": [list(lattice.shape(s)) for s in range(lattice.finest + 1)],
            },
            "weights": {
                "file": WEIGHTS_NAME,
                "sha256": digest(path),
                "dtype": "float32",
                "shapes": shape,
                "network_weights": sum(p.numel() for p in model.parameter_groups()[1]),
                "texels": sum(p.numel() for p in model.parameter_groups()[0]),
            },
            "conformance": {
                "count": CONFORMANCE_COUNT,
                "tensors": [f"conformance.{name}" for name in _CONFORMANCE],
                "tolerance": 1e-4,
                "note": "evaluating the first four must give the fifth within tolerance * max(1, value)",
            },
            "config": config.model_dump(mode="json"),
            "data": data,
            "training": training,
        },
    )
    return Material.load(folder)


_CONVENTIONS = {
    "textures": "weights of a texture are (rows, columns, channels); row 0 is the side v -> 1; texel centres "
    "at ((i+1/2)/W, 1-(j+1/2)/H); bilinear between them, wrapped in both directions",
    "blending": "level l = clamp(-log2(2 sigma), 0, k); features are (1-frac(l)) * level floor(l) + "
    "frac(l) * level floor(l)+1",
    "networks": "x -> weight x + bias, ReLU after every layer but the last; weight is (outputs, inputs)",
    "clamp": "values below 0 are set to 0",
}
