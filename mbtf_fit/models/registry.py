"""The models by name: those of this folder, whose every file is read, so that a new model is one new file,
and those of other packages, which declare them as entry points of the group ``mbtf.models``."""

from __future__ import annotations

import importlib
import pkgutil
from typing import TYPE_CHECKING, Any

import mbtf_fit.models
from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import InputError, reason
from mbtf_fit.models import FOREIGN
from mbtf_fit.models.model import Model
from mbtf_fit.sections import NetworkSection

if TYPE_CHECKING:
    from mbtf_fit.pytorch.material import NeuralMaterial


def _find() -> dict[str, type[Model]]:
    found: dict[str, type[Model]] = {}
    for entry in pkgutil.iter_modules(mbtf_fit.models.__path__, "mbtf_fit.models."):
        if entry.name == __name__:
            continue
        for item in vars(importlib.import_module(entry.name)).values():
            own = isinstance(item, type) and issubclass(item, Model) and item.__module__ == entry.name
            if own and "name" in vars(item):
                found[item.name] = item
    for name, point in FOREIGN.items():
        try:
            model = point.load()
        except Exception as error:  # whatever the code of others raises
            raise _unusable(name, reason(error)) from error
        if not (isinstance(model, type) and issubclass(model, Model) and getattr(model, "name", "") == name):
            raise _unusable(name, f"{point.value} is no model of this name")
        if name in found:
            raise _unusable(name, "a model of this project has the same name")
        found[name] = model
    return found


def _unusable(name: str, why: str) -> InputError:
    return InputError(
        f"cannot be used ({why})",
        where=f"entry point '{name}' of mbtf.models",
        hint="correct or uninstall its package",
    )


MODELS = _find()


def material_of(name: str, lattice: Lattice, network: NetworkSection) -> NeuralMaterial:
    """An uninitialized material of a model and an architecture."""
    from mbtf_fit.pytorch.material import NeuralMaterial

    return NeuralMaterial(lattice, MODELS[name].operations(lattice, network), name)


def with_option(option: str) -> list[str]:
    """Names of the models that take an option of :data:`mbtf_fit.models.model.SPECIAL`."""
    return [name for name, model in MODELS.items() if option in model.takes]


def defaults_of(name: str) -> dict[str, Any]:
    """Options of a model that differ from the general defaults, nested."""
    return dict(MODELS[name].defaults) if name in MODELS else {}
