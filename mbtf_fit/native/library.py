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
MAX_CHANNELS, MAX_WIDTH, MAX_LAYERS, MAX_LEVELS, MAX_PLACES = 64, 128, 16, 16, 16

_I32, _I64, _F32, _POINTER = ctypes.c_int32, ctypes.c_int64, ctypes.c_float, ctypes.c_void_p
# Version of what the functions mean, where sizes of structures do not show it; as in src/kernel.h.
INTERFACE = 9


class NetworkStruct(ctypes.Structure):
    """``mbtf_network``"""

    _fields_ = (("layers", _I32), ("wanted", _I32), ("widths", _I32 * (MAX_LAYERS + 1)), ("packed", _POINTER))


class TexturesStruct(ctypes.Structure):
    """``mbtf_textures``"""

    _fields_ = (
        *((name, _I32) for name in ("levels", "channels")),
        *((name, _I32 * MAX_LEVELS) for name in ("rows", "columns")),
        ("starts", _I64 * (MAX_LEVELS + 1)),
        ("table", _POINTER),
    )


class ModelStruct(ctypes.Structure):
    """``mbtf_model``"""

    _fields_ = (
        *((name, TexturesStruct) for name in ("pyramid", "offset_texture")),
        *((name, NetworkStruct) for name in ("decoder", "offset")),
        *((name, _F32) for name in ("unit", "most", "offset_scale", "grazing", "aspect")),
        *((name, _F32) for name in ("irradiance_scale", "depth_scale", "height_scale", "least_facing")),
        *((name, _I32) for name in ("coordinates", "half_vector", "hints", "frame", "fibers", "gate")),
        ("depth_weights", _POINTER),
    )


class QueryPointers(ctypes.Structure):
    """``mbtf_queries``"""

    _fields_ = (("n", _I64), *((name, _POINTER) for name in ("u", "sigma", "omega_i", "omega_o", "hints")))


class Heightfield(ctypes.Structure):
    """``mbtf_heightfield``"""

    _fields_ = (
        *((name, _POINTER) for name in ("nodes", "z")),
        *((name, _I32) for name in ("columns", "rows", "columns_log2", "both_log2", "finest")),
        ("aspect", _F32),
    )


class SurfaceStruct(ctypes.Structure):
    """``mbtf_surface``"""

    _fields_ = (
        ("heightfield", Heightfield),
        *((name, TexturesStruct) for name in ("maps", "horizons", "fibers")),
        ("places", _I32),
        ("offsets", _F32 * (2 * MAX_PLACES)),
        *((name, _F32) for name in ("finer", "light_width", "light_blur", "dielectric")),
        *((name, _F32) for name in ("edge", "coat", "least_view")),
        *((name, _F32 * 2) for name in ("albedo_spread", "alpha2", "voigt")),
        *((name, _F32) for name in ("fiber_finer", "least_tangents", "least_cosine", "least_spread")),
        ("light_depth", _F32),
    )


class GradientSums(ctypes.Structure):
    """``mbtf_gradients``"""

    _fields_ = tuple(
        (name, _POINTER) for name in ("pyramid", "offset_texture", "decoder", "offset", "depth_weights")
    )


class QuadraticLoss(ctypes.Structure):
    """``mbtf_loss``"""

    _fields_ = (
        *((name, _F32) for name in ("relative", "squared", "chroma", "scale")),
        ("bound", _F32 * 3),
        ("bounded", _I32),
    )


class AdamStep(ctypes.Structure):
    """``mbtf_adam_step``"""

    _fields_ = tuple((name, _F32) for name in ("rate", "beta1", "beta2", "epsilon", "root_correction2"))


# Types of results and arguments by letter.
_TYPES: dict[str, Any] = {
    **{"i": _I32, "l": _I64, "f": _F32, "d": ctypes.c_double},
    **{"s": ctypes.c_char_p, "p": _POINTER, "v": None},
}
# Of each function the result, then the arguments.
_PROTOTYPES = {
    "mbtf_variants": "i",
    "mbtf_variant_name": "si",
    "mbtf_block": "i",
    "mbtf_lanes": "i",
    "mbtf_layout": "i",
    "mbtf_state_floats": "lp",
    "mbtf_scratch_floats": "l",
    "mbtf_packed_floats": "lp",
    "mbtf_pack": "vippp",
    "mbtf_forward": "vippiipp",
    "mbtf_backward": "vipppppp",
    "mbtf_learn": "dippppfpppp",
    "mbtf_collect_weights": "vpplp",
    "mbtf_collect": "vipllllp",
    "mbtf_adam": "viplpppp",
    "mbtf_blur_down": "vipllplllpp",
    "mbtf_blur_across": "vipllplllppp",
    "mbtf_resample": "viplllpplpplllpp",
    "mbtf_trace": "vplppip",
    "mbtf_horizons": "vpifllp",
    "mbtf_hints": "vppfip",
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


def open_library(path: Path) -> Any:
    """Load a library.

    Raises
    ------
    OSError : it cannot be loaded, lacks a function, or was built from other sources
    """
    library = ctypes.CDLL(str(path))
    for name, letters in _PROTOTYPES.items():
        try:
            function = getattr(library, name)
        except AttributeError:
            raise OSError(f"it lacks {name}") from None
        function.restype, *function.argtypes = (_TYPES[letter] for letter in letters)
    if library.mbtf_layout() != ctypes.sizeof(ModelStruct) + 4096 * ctypes.sizeof(QueryPointers) + INTERFACE:
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
    paths = (Path(__file__).with_name(f"{LIBRARY}{suffix}") for suffix in EXTENSION_SUFFIXES)
    path = next((path for path in paths if path.is_file()), None)
    if path is None:
        return None, "not built: there was no C compiler, or the wheel is one for any machine"
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
