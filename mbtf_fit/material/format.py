"""Format of material folders: names, schema, conventions, and checks of a reader.

Does not import PyTorch, so that renderers can read a material without it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, Field

from mbtf_core.config.settings import check_document, check_schema
from mbtf_core.data.lattice import MAX_LEVEL, Lattice
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import file_sha256, read_json
from mbtf_core.paths import suggest_path

FORMAT_NAME = "mbtf-material"
SCHEMA_VERSION = 3
DESCRIPTION_NAME = "material.json"
WEIGHTS_NAME = "weights.safetensors"
# Smallest cosine of the directions in data that do not state one.
DEFAULT_MIN_COS = 0.1
# Number of conformance queries; their arrays, expected values last, and the shape of a query in each.
CONFORMANCE_COUNT = 256
CONFORMANCE = {"u": (2,), "sigma": (), "omega_i": (3,), "omega_o": (3,), "rgb": (3,)}
QUERY = tuple(CONFORMANCE)[:-1]
# Hint for a damaged material.
AGAIN = "copy the folder again, or fit again"


class _File(BaseModel):
    sha256: str


class _Weights(_File):
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


class _Data(BaseModel):
    min_cos: Annotated[float, Field(strict=True, gt=0, lt=1)] = DEFAULT_MIN_COS


class _Description(BaseModel):
    """Keys of ``material.json`` that readers require; it has more."""

    model: str
    config: dict[str, Any]
    operations: list[dict[str, Any]]
    weights: _Weights
    levels: _Levels
    tile: _Tile
    conformance: _Conformance
    training: _Training
    data: _Data
    transmittance: _File | None = None


def read_description(folder: Path) -> tuple[dict[str, Any], Path]:
    """Content of ``material.json``, validated, and the path of the weights, with their digest verified.

    Raises
    ------
    InputError : missing, corrupt, or of another schema
    """
    if not folder.is_dir():
        raise InputError("no such folder", where=folder, hint=suggest_path(folder, Path.is_dir))
    path = folder / DESCRIPTION_NAME
    if not path.exists():
        raise InputError(
            f"no {DESCRIPTION_NAME} in it",
            where=folder,
            hint="make a material with: mbtf-fit SHARDS -o FOLDER",
        )
    description = read_json(path, AGAIN)
    if description.get("format") != FORMAT_NAME:
        raise InputError(f"does not describe a material ({FORMAT_NAME})", where=path, hint=AGAIN)
    check_schema(description, SCHEMA_VERSION, path, "fit it again with this version of mbtf-fit")
    check_document(_Description, description, path, AGAIN)
    return description, check_digest(folder / WEIGHTS_NAME, description["weights"])


def check_digest(path: Path, stated: Mapping[str, Any], by: str = DESCRIPTION_NAME) -> Path:
    """The path of a file whose digest is the one that the file `by` states.

    Raises
    ------
    InputError : it is missing or corrupt
    """
    if not path.is_file():
        raise InputError(f"no such file, but {by} names it", where=path, hint=AGAIN)
    if file_sha256(path) != stated["sha256"]:
        raise InputError(
            f"is damaged, or of another material (its SHA-256 is not that in {by})",
            where=path,
            hint=AGAIN,
        )
    return path


def lattice_of(description: Mapping[str, Any]) -> Lattice:
    """Texel grids of a described material."""
    return Lattice(description["levels"]["finest"], description["tile"]["aspect"])


def check_conformance(
    tensors: Mapping[str, ArrayLike], description: Mapping[str, Any], weights: Path
) -> dict[str, NDArray[np.float32]]:
    """The conformance queries among a file's tensors and their values ``rgb``, by name.

    Raises
    ------
    InputError : one is missing or of a wrong shape
    """
    out = {}
    for name, width in CONFORMANCE.items():
        tensor = f"conformance.{name}"
        if tensor not in tensors:
            raise InputError(f"lacks the tensor '{tensor}'", where=weights)
        out[name] = np.asarray(tensors[tensor], np.float32)
        if out[name].shape != (description["conformance"]["count"], *width):
            raise InputError(f"its tensor '{tensor}' has the shape {out[name].shape}", where=weights)
    return out


MATERIAL_CONVENTIONS = {
    "operations": "each computes named values from others, and from u, omega_i, omega_o and "
    "level = clamp(-log2(2 sigma), 0, finest); name[a:b] are the numbers a to b - 1; the last value is the "
    "answer in 1/sr",
    "textures": "weights of a texture are (rows, columns, channels); row 0 is the side v -> 1; texel centers "
    "at ((i+1/2)/W, 1-(j+1/2)/H); bilinear between them, wrapped in both directions",
    "blending": "features are (1-frac(l)) * level floor(l) + frac(l) * level floor(l)+1",
    "networks": "x -> weight x + bias; weight is (outputs, inputs), of a convolution (outputs, inputs, rows, "
    "columns)",
    "clamp": "values below 0 are set to 0",
}
