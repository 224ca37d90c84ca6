"""Tensors and plain data in one safetensors file, written atomically. No pickle anywhere."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, BinaryIO

import torch
from torch import Tensor

from mbtf_core.atomic import write_file
from mbtf_core.errors import InputError, reason

_KEY = "mbtf"


def write_tensors(path: Path, tensors: dict[str, Tensor], data: dict[str, Any]) -> None:
    """Write tensors, and JSON data in the file's header.

    Raises
    ------
    PartialError : the disk is full or the folder cannot be written
    """
    from safetensors.torch import save

    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    content = save(plain, metadata={_KEY: json.dumps(data)})

    def write(stream: BinaryIO) -> None:
        stream.write(content)

    write_file(path, write)


def read_tensors(path: Path, device: torch.device | str = "cpu") -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read a file of :func:`write_tensors`: (tensors, data).

    Raises
    ------
    InputError : missing or corrupt
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt", device=str(device)) as file:
            data = json.loads((file.metadata() or {}).get(_KEY, "{}"))
            return {name: file.get_tensor(name) for name in file.keys()}, data  # noqa: SIM118
    except FileNotFoundError:
        raise InputError("no such file", where=path) from None
    except (SafetensorError, OSError, ValueError, RecursionError) as error:
        raise InputError(f"cannot be read as tensors ({reason(error)})", where=path) from None
