"""Format of material folders: names, schema, conventions, files of tensors, and checks of a reader.

Does not import PyTorch, so that renderers can read a material without it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, Field

from mbtf_core.config.settings import check_document, check_schema
from mbtf_core.data.lattice import MAX_LEVEL, Lattice
from mbtf_core.errors import InputError, reason
from mbtf_core.files.atomic import Stored, file_sha256, read_json, write_chunks
from mbtf_core.paths import refuse_special, suggest_path
from mbtf_fit.material.texture_formats import RANGE, TextureFormat, decode, range_name

if TYPE_CHECKING:
    from torch import Tensor

FORMAT_NAME = "mbtf-material"
SCHEMA_VERSION = 10
DESCRIPTION_NAME = "material.json"
WEIGHTS_NAME = "weights.safetensors"
# Smallest cosine of the directions in data that do not state one.
DEFAULT_MIN_COS = 0.1
# Number of conformance queries; their arrays, expected values last, and the shape of a query in each.
CONFORMANCE_COUNT = 256
CONFORMANCE = {"u": (2,), "sigma": (), "omega_i": (3,), "omega_o": (3,), "rgb": (3,)}
QUERY = tuple(CONFORMANCE)[:-1]
# Where the header of a file of tensors has JSON data.
_KEY = "mbtf"
# Most tensors of a file, each of which takes a call.
_MOST_TENSORS = 10_000
# Hint for a damaged material.
AGAIN = "copy the folder again, or fit again"


class _File(BaseModel):
    sha256: str


class _Weights(_File):
    dtype: TextureFormat
    network_weights: int
    texels: int


class _Levels(BaseModel):
    finest: Annotated[int, Field(strict=True, ge=0, le=MAX_LEVEL)]


class _Tile(BaseModel):
    aspect: Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)]


class _Conformance(BaseModel):
    count: int


class _Estimate(BaseModel):
    value: float | None
    error: float | None


class _Errors(BaseModel):
    n: int
    mse: _Estimate
    unexplained: _Estimate
    exposure: Annotated[float, Field(ge=-1000, le=1000)]


class _Training(BaseModel):
    steps: int
    batch: int
    seconds: float
    device: str
    threads: int
    errors: dict[str, _Errors]


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
        # A library has them in NAME/fits/FIT.
        inside = [str(p.parent) for k in (1, 2, 3) for p in sorted(folder.glob("*/" * k + DESCRIPTION_NAME))]
        hint = f"materials in it: {', '.join(inside[:5])}{', …' * (len(inside) > 5)}"
        hint = hint if inside else "make a material with: mbtf-fit SHARDS -o FOLDER"
        raise InputError(f"no {DESCRIPTION_NAME} in it", where=folder, hint=hint)
    description = read_json(path, AGAIN)
    if description.get("format") != FORMAT_NAME:
        raise InputError(f"is not of the format {FORMAT_NAME}", where=path, hint=AGAIN)
    check_schema(description, SCHEMA_VERSION, path, "fit it again with this version of mbtf-fit")
    check_document(_Description, description, path, AGAIN)
    return description, check_digest(folder / WEIGHTS_NAME, description["weights"])


def check_digest(path: Path, stated: Mapping[str, Any]) -> Path:
    """The path of a file whose digest is the one that ``material.json`` states.

    Raises
    ------
    InputError : it is missing or corrupt
    """
    if not path.is_file():
        raise InputError(f"no such file, but {DESCRIPTION_NAME} names it", where=path, hint=AGAIN)
    if file_sha256(path) != stated["sha256"]:
        raise InputError(
            f"is damaged, or of another material (its SHA-256 is not that in {DESCRIPTION_NAME})",
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


def write_tensors(path: Path, tensors: dict[str, Tensor], data: dict[str, Any]) -> Stored:
    """Write tensors, and JSON data in the file's header.

    Raises
    ------
    PartialError : the disk is full or the folder cannot be written
    """
    from safetensors.torch import save

    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    return write_chunks(path, [save(plain, metadata={_KEY: json.dumps(data)})])


def read_tensors(path: Path, framework: str = "pt") -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a safetensors file: (PyTorch tensors, or NumPy arrays of the framework ``np``; data).

    Raises
    ------
    InputError : missing or corrupt
    """
    from safetensors import SafetensorError, safe_open

    refuse_special(path)
    try:
        with safe_open(path, framework=framework) as file:
            data = json.loads((file.metadata() or {}).get(_KEY, "{}"))
            if len(file.keys()) > _MOST_TENSORS:
                raise InputError(f"has more than {_MOST_TENSORS:,} tensors", where=path)
            return {name: file.get_tensor(name) for name in file.keys()}, data  # noqa: SIM118
    except FileNotFoundError:
        raise InputError("no such file", where=path) from None
    except (SafetensorError, OSError, TypeError, ValueError, RecursionError) as error:
        raise InputError(f"cannot be read as tensors ({reason(error)})", where=path) from None


def read_weights(path: Path, description: Mapping[str, Any], framework: str = "pt") -> dict[str, Any]:
    """Tensors of a described material, as :func:`read_tensors`; quantized textures as the floats that they
    stand for.

    Raises
    ------
    InputError : missing or corrupt, or a tensor has other numbers than finite floats
    """
    tensors, _ = read_tensors(path, framework)
    ranges = {name: np.asarray(tensors.pop(name)) for name in [*tensors] if name.endswith(RANGE)}
    for name in [name for name, t in tensors.items() if "uint" in str(t.dtype)] if ranges else []:
        try:
            limits = ranges[range_name(name)]
            texels = decode(np.asarray(tensors[name]), limits, description["weights"]["shapes"][name])
        except (KeyError, ValueError, TypeError) as error:
            what = f"its quantized texture '{name}' cannot be decoded ({reason(error)})"
            raise InputError(what, where=path, hint=AGAIN) from None
        tensors[name] = texels
        if framework == "pt":
            import torch

            tensors[name] = torch.from_numpy(texels)
    for name, tensor in tensors.items():
        try:
            array = np.asarray(tensor)
        except TypeError:  # a type that NumPy lacks
            array = np.empty(0, np.bool_)
        if array.dtype.kind != "f":
            what = f"its tensor '{name}' has numbers of another type than 16, 32 or 64-bit floats"
            raise InputError(what, where=path, hint=AGAIN)
        if not np.isfinite(array).all():
            raise InputError(f"its tensor '{name}' has numbers that are not finite", where=path, hint=AGAIN)
    return tensors


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
