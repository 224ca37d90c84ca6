"""Finding and calling the compiled library."""

from __future__ import annotations

import ctypes
import os
from dataclasses import dataclass
from functools import cache
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from typing import Any

# Environment variable that selects the kernel: "off", or a variant; by default the fastest one.
ENVIRONMENT = "MBTF_KERNEL"
# Name of the library in this folder, without suffix.
LIBRARY = "_kernel"
# Largest sizes that the kernel takes; as in src/kernel.h.
MAX_CHANNELS, MAX_WIDTH, MAX_LAYERS, MAX_LEVELS = 64, 128, 16, 16

_I32, _I64, _F32, _POINTER = ctypes.c_int32, ctypes.c_int64, ctypes.c_float, ctypes.c_void_p


class Network(ctypes.Structure):
    """``mbtf_network``"""

    _fields_ = (
        ("layers", _I32),
        ("wanted", _I32),
        ("widths", _I32 * (MAX_LAYERS + 1)),
        ("packed", _POINTER),
    )


class Textures(ctypes.Structure):
    """``mbtf_textures``"""

    _fields_ = (
        ("levels", _I32),
        ("channels", _I32),
        ("rows", _I32 * MAX_LEVELS),
        ("columns", _I32 * MAX_LEVELS),
        ("starts", _I64 * (MAX_LEVELS + 1)),
        ("table", _POINTER),
    )


class Model(ctypes.Structure):
    """``mbtf_model``"""

    _fields_ = (
        ("pyramid", Textures),
        ("offset_texture", Textures),
        ("decoder", Network),
        ("offset", Network),
        ("unit", _F32),
        ("offset_scale", _F32),
        ("grazing", _F32),
        ("aspect", _F32),
        ("coordinates", _I32),
    )


class QueryPointers(ctypes.Structure):
    """``mbtf_queries``"""

    _fields_ = (
        ("n", _I64),
        ("u", _POINTER),
        ("sigma", _POINTER),
        ("omega_i", _POINTER),
        ("omega_o", _POINTER),
    )


class GradientSums(ctypes.Structure):
    """``mbtf_gradients``"""

    _fields_ = (
        ("pyramid", _POINTER),
        ("offset_texture", _POINTER),
        ("decoder", _POINTER),
        ("offset", _POINTER),
    )


class QuadraticLoss(ctypes.Structure):
    """``mbtf_loss``"""

    _fields_ = (
        ("relative", _F32),
        ("squared", _F32),
        ("scale", _F32),
        ("bound", _F32 * 3),
        ("bounded", _I32),
    )


class AdamStep(ctypes.Structure):
    """``mbtf_adam_step``"""

    _fields_ = (
        ("rate", _F32),
        ("beta1", _F32),
        ("beta2", _F32),
        ("epsilon", _F32),
        ("root_correction2", _F32),
    )


_PROTOTYPES: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "mbtf_variants": (_I32, ()),
    "mbtf_variant_name": (ctypes.c_char_p, (_I32,)),
    "mbtf_block": (_I32, ()),
    "mbtf_lanes": (_I32, ()),
    "mbtf_layout": (_I32, ()),
    "mbtf_state_floats": (_I64, (_POINTER,)),
    "mbtf_scratch_floats": (_I64, ()),
    "mbtf_packed_floats": (_I64, (_POINTER,)),
    "mbtf_pack": (None, (_I32, _POINTER, _POINTER, _POINTER)),
    "mbtf_forward": (None, (_I32, _POINTER, _POINTER, _I32, _I32, _POINTER, _POINTER)),
    "mbtf_backward": (None, (_I32, _POINTER, _POINTER, _POINTER, _POINTER, _POINTER, _POINTER)),
    "mbtf_learn": (
        ctypes.c_double,
        (_I32, _POINTER, _POINTER, _POINTER, _POINTER, _F32, _POINTER, _POINTER, _POINTER, _POINTER),
    ),
    "mbtf_collect_weights": (None, (_POINTER, _POINTER, _I64, _POINTER)),
    "mbtf_collect": (None, (_I32, _POINTER, _I64, _I64, _I64, _I64, _POINTER)),
    "mbtf_adam": (None, (_I32, _POINTER, _I64, _POINTER, _POINTER, _POINTER, _POINTER)),
    "mbtf_blur_down": (
        None,
        (_I32, _POINTER, _I64, _I64, _POINTER, _I64, _I64, _I64, _POINTER, _POINTER),
    ),
    "mbtf_blur_across": (
        None,
        (_I32, _POINTER, _I64, _I64, _POINTER, _I64, _I64, _I64, _POINTER, _POINTER, _POINTER),
    ),
}


@dataclass(frozen=True)
class Kernel:
    """The loaded library and the instruction set that it uses.

    Attributes
    ----------
    library : functions ``mbtf_*``; calls release the interpreter's lock
    variant : number of the instruction set, first argument of what is vectorized; name : its name
    """

    library: Any
    variant: int
    name: str

    @property
    def block(self) -> int:
        """Queries per block."""
        return int(self.library.mbtf_block())

    @property
    def lanes(self) -> int:
        """Partial sums of each weight's gradient."""
        return int(self.library.mbtf_lanes())


def _path() -> Path | None:
    here = Path(__file__).parent
    found = (here / f"{LIBRARY}{suffix}" for suffix in EXTENSION_SUFFIXES)
    return next((path for path in found if path.is_file()), None)


def open_library(path: Path) -> Any:
    """Load a library.

    Raises
    ------
    OSError : it cannot be loaded, lacks a function, or was built from other sources
    """
    library = ctypes.CDLL(str(path))
    for name, (result, arguments) in _PROTOTYPES.items():
        try:
            function = getattr(library, name)
        except AttributeError:
            raise OSError(f"it lacks {name}") from None
        function.restype, function.argtypes = result, list(arguments)
    if library.mbtf_layout() != ctypes.sizeof(Model) + 4096 * ctypes.sizeof(QueryPointers):
        raise OSError("it was built from other sources")
    return library


def variants(library: Any) -> dict[str, int]:
    """Instruction sets that library and processor have, fastest first: name → number."""
    names = {k: library.mbtf_variant_name(k) for k in range(library.mbtf_variants())}
    return {name.decode(): k for k, name in names.items() if name is not None}


@cache
def _load() -> tuple[Kernel | None, str]:
    requested = os.environ.get(ENVIRONMENT, "auto")
    if requested == "off":
        return None, f"switched off by {ENVIRONMENT}"
    path = _path()
    if path is None:
        return None, "not built: no C compiler was found when mbtf was installed"
    try:
        library = open_library(path)
    except OSError as error:
        return None, f"cannot be loaded ({error})"
    found = variants(library)
    name = next(iter(found)) if requested == "auto" else requested
    if name not in found:
        return None, f"{ENVIRONMENT}={requested} is not one of: {', '.join(['auto', 'off', *found])}"
    return Kernel(library, found[name], name), ""


def kernel() -> Kernel | None:
    """The kernel of this installation, or None (see :func:`missing_reason`)."""
    return _load()[0]


def missing_reason() -> str:
    """Why :func:`kernel` is None; empty if it is not."""
    return _load()[1]


def describe() -> str:
    """Name of this machine's CPU backend."""
    found, reason = _load()
    return f"compiled kernel ({found.name})" if found is not None else f"PyTorch; compiled kernel: {reason}"


def reload() -> None:
    """Load again, after a change of the environment."""
    _load.cache_clear()
