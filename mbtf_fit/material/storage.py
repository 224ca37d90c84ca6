"""Tensors and plain data in one safetensors file, written atomically. No pickle anywhere."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mbtf_core.errors import InputError, reason
from mbtf_core.files.atomic import Stored, write_chunks
from mbtf_core.paths import refuse_special

if TYPE_CHECKING:
    from torch import Tensor

_KEY = "mbtf"


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
            return {name: file.get_tensor(name) for name in file.keys()}, data  # noqa: SIM118
    except FileNotFoundError:
        raise InputError("no such file", where=path) from None
    except (SafetensorError, OSError, TypeError, ValueError, RecursionError) as error:
        raise InputError(f"cannot be read as tensors ({reason(error)})", where=path) from None
