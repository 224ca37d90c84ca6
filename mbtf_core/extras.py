"""Packages of optional extras: their import, and the error that names the extra where one is missing."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any

from mbtf_core.errors import EngineError, reason

# Of each module the extra that installs it, and the name of its distribution.
EXTRAS = {
    "dask": ("cluster", "dask"),
    "dask_jobqueue": ("cluster", "dask-jobqueue"),
    "distributed": ("cluster", "distributed"),
    "fsspec": ("stores", "fsspec"),
    "h5py": ("hdf5", "h5py"),
    "MaterialX": ("maps", "MaterialX"),
    "mlcroissant": ("publish", "mlcroissant"),
    "pxr": ("maps", "usd-core"),
    "pyarrow": ("publish", "pyarrow"),
    "pygltflib": ("maps", "pygltflib"),
    "s3fs": ("stores", "s3fs"),
    "slangpy": ("shaders", "slangpy"),
    "stlpips_pytorch": ("perceptual", "stlpips-pytorch"),
}


def has_extra(module: str) -> bool:
    """Whether a module of the table is installed; it is not imported."""
    return find_spec(module) is not None


def extra_error(module: str, where: object, fault: str = "is not installed") -> EngineError:
    """The error that says which extra installs a module of the table; `where` (file, option or key) needs it,
    `fault` is wrong with it."""
    extra, distribution = EXTRAS[module]
    return EngineError(f"{distribution} {fault}", where=where, hint=f"pip install 'mbtf[{extra}]'")


def import_extra(name: str, where: object) -> Any:
    """Import a module of the table, or one inside it, with dots; an EngineError that names `where` (file,
    option or key) if it is not installed, or cannot be imported."""
    top = name.partition(".")[0]
    try:
        return import_module(name)
    except ImportError as error:
        missing = isinstance(error, ModuleNotFoundError) and error.name == top
        fault = "is not installed" if missing else f"cannot be imported ({reason(error)})"
        raise extra_error(top, where, fault) from None
