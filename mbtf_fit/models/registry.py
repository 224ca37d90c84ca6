"""The models by name: those of this folder, whose every file is read, so that a new model is one new file,
and those of other packages, which declare them as entry points of the group ``mbtf.models``. And models of
any file, by its path and their class."""

from __future__ import annotations

import importlib
import pkgutil
import sys
from collections.abc import Container, Iterator
from contextlib import contextmanager
from functools import lru_cache
from importlib.metadata import EntryPoint
from pathlib import Path
from traceback import extract_tb
from types import ModuleType
from typing import TYPE_CHECKING, Any

import mbtf_fit.models
from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import InputError, MbtfError, reason
from mbtf_core.paths import refuse_special, suggest_name
from mbtf_fit.models import FOREIGN, file_and_class
from mbtf_fit.models.model import Model
from mbtf_fit.ops import Operation
from mbtf_fit.sections import NetworkSection

if TYPE_CHECKING:
    from mbtf_fit.pytorch.material import NeuralMaterial


def _find() -> tuple[dict[str, type[Model]], dict[str, InputError]]:
    """The models by name, and why those of other packages cannot be used: others stay usable."""
    found, faults = dict[str, type[Model]](), dict[str, InputError]()
    for entry in pkgutil.iter_modules(mbtf_fit.models.__path__, "mbtf_fit.models."):
        if entry.name == __name__:
            continue
        for item in vars(importlib.import_module(entry.name)).values():
            own = isinstance(item, type) and issubclass(item, Model) and item.__module__ == entry.name
            if own and "name" in vars(item):
                found[item.name] = item
    for name, point in FOREIGN.items():
        try:
            found[name] = _foreign(name, point, found)
        except (Exception, SystemExit) as error:  # whatever the code of others raises
            where, hint = f"entry point '{name}' of mbtf.models", "correct or uninstall its package"
            faults[name] = InputError(f"cannot be used ({reason(error)})", where=where, hint=hint)
            faults[name].__cause__ = error
    return found, faults


def _foreign(name: str, point: EntryPoint, known: Container[str]) -> type[Model]:
    """The model of an entry point; a ValueError where it is none, or its name that of a known one."""
    model = point.load()
    if not (isinstance(model, type) and issubclass(model, Model)):
        raise ValueError(f"{point.value} is no model")
    if (named := getattr(model, "name", "")) != name:
        raise ValueError(f"{point.value} has the name '{named}', which must be that of the entry point")
    if name in known:
        raise ValueError("a model of this project has the same name")
    if not hasattr(model, "description"):
        raise ValueError(f"{point.value} has no description")
    return model


MODELS, UNUSABLE = _find()


def model_class(name: str) -> type[Model]:
    """The model of a name, or of a file: ``FILE.py:CLASS``. Without a name of its own, that of the class is
    the model's name.

    Raises
    ------
    InputError : the file is missing or raises an exception, or has no such model, or the package of that
        name cannot be used
    """
    if name in MODELS:
        return MODELS[name]
    if name in UNUSABLE:
        raise UNUSABLE[name]
    file, wanted = file_and_class(name) or ("", name)
    path = Path(file)
    refuse_special(path)
    with _faults_of(name):
        try:
            text = path.read_text(encoding="utf-8")
        except FileNotFoundError:
            raise InputError("no such file", where=file, hint=f"searched for {path.absolute()}") from None
        found = vars(_run(path, text))
    model = found.get(wanted)
    if not (isinstance(model, type) and issubclass(model, Model) and model is not Model):
        own = [n for n, c in found.items() if isinstance(c, type) and issubclass(c, Model) and c is not Model]
        what = f"'{wanted}' is no subclass of Model" if wanted in found else f"has no class '{wanted}'"
        raise InputError(what, where=file, hint=f"models in it: {', '.join(own) or 'none'}")
    if all("operations" not in vars(base) for base in model.__mro__ if base is not Model):
        hint = suggest_name("operations", list(vars(model)))
        raise InputError(f"'{wanted}' has no method 'operations'", where=file, hint=hint)
    if "name" not in vars(model):
        model.name = wanted
    if model.name in MODELS:
        hint = "give the class another name = ..."
        raise InputError(f"its name '{model.name}' is that of an installed model", where=name, hint=hint)
    return model


@lru_cache(maxsize=16)
def _run(path: Path, text: str) -> ModuleType:
    """The module of a file, run once per content."""
    module = ModuleType(str(path))
    module.__file__ = str(path)
    # Dataclasses look up the module of their annotations.
    sys.modules[module.__name__] = module
    exec(compile(text, path, "exec"), vars(module))
    return module


@contextmanager
def _faults_of(name: str) -> Iterator[None]:
    """Name the file and the line of whatever exception a model's file raises."""
    try:
        yield
    except (Exception, SystemExit) as error:
        if name in MODELS or isinstance(error, MbtfError):
            raise
        path, _ = file_and_class(name) or ("", name)
        places = [(frame.filename, frame.lineno) for frame in extract_tb(error.__traceback__)]
        what, hint = reason(error), "correct the file; --debug shows the traceback"
        if isinstance(error, SyntaxError):
            what = reason(error.msg)
            places.append((error.filename or "", error.lineno))
        lines = [line for file, line in places if file == path]
        where = f"{path}:{lines[-1]}" if lines else path
        raise InputError(f"{type(error).__name__}: {what}", where=where, hint=hint) from error


def operations_of(name: str, lattice: Lattice, network: NetworkSection) -> list[Operation]:
    """The operations of a model, for texel grids and an architecture.

    Raises
    ------
    InputError : the code of a model's file raises an exception
    """
    with _faults_of(name):
        return model_class(name).operations(lattice, network)


def material_of(name: str, lattice: Lattice, network: NetworkSection) -> NeuralMaterial:
    """An uninitialized material of a model and an architecture.

    Raises
    ------
    InputError : the code of a model's file raises an exception, or its operations do not fit together
    """
    from mbtf_fit.pytorch.material import NeuralMaterial

    with _faults_of(name):
        return NeuralMaterial(lattice, operations_of(name, lattice, network), model_class(name).name)


def with_option(option: str) -> list[str]:
    """Names of the models that take an option of :data:`mbtf_fit.models.model.SPECIAL`."""
    return [name for name, model in MODELS.items() if option in model.takes]


def defaults_of(name: str) -> dict[str, Any]:
    """Options of a model that differ from the general defaults, nested.

    Raises
    ------
    InputError : the code of a model's file raises an exception, or they are no mapping
    """
    with _faults_of(name):
        return dict(model_class(name).defaults) if name in MODELS or file_and_class(name) else {}
