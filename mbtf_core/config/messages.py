"""Pydantic's validation errors, rephrased for users of the programs."""

from __future__ import annotations

import types
import typing
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Union

from pydantic import BaseModel

_BOUNDS = (("ge", "at least"), ("gt", "above"), ("le", "at most"), ("lt", "below"))
_TEMPLATES = {
    "literal_error": "must be {expected}",
    "too_short": "must hold at least {min_length}",
    "string_pattern_mismatch": "must match {pattern}",
    "string_too_short": "must not be empty",
}
# Beginnings of pydantic's names of faults → what was expected.
_FAMILIES = {
    "int": "must be a whole number",
    "float": "must be a number",
    "finite": "must be a finite number",
    "bool": "must be true or false",
    "string": "must be text",
    "list": "must be a list",
    "tuple": "must be a list",
    "dict": "must hold keys and values",
    "model": "must hold keys and values",
}


def models_in(annotation: Any) -> list[type[BaseModel]]:
    """The models that a field's annotation may hold: through Optional, unions, lists and dicts."""
    return [part for part in parts_of(annotation) if isinstance(part, type) and issubclass(part, BaseModel)]


def parts_of(annotation: Any) -> list[Any]:
    """An annotation without its Optional, unions, lists and dicts; `Annotated` parts stay whole."""
    origin = typing.get_origin(annotation)
    if origin is Annotated:
        inner, *notes = typing.get_args(annotation)
        deeper = parts_of(inner)
        return [*deeper, *notes]
    if origin in (Union, types.UnionType, list, tuple, dict):
        return [p for a in typing.get_args(annotation) for p in parts_of(a)]
    return [annotation]


def _limits(model: type[BaseModel], location: Sequence[str | int]) -> dict[str, float]:
    """Bounds that the field at `location` states: ``ge``, ``gt``, ``le``, ``lt`` → number."""
    models, notes = [model], []
    for part in location:
        fields = [m.model_fields[part] for m in models if isinstance(part, str) and part in m.model_fields]
        if fields:
            notes = [n for f in fields for n in (*f.metadata, *parts_of(f.annotation))]
            models = [m for f in fields for m in models_in(f.annotation)] or models
    found = {}
    for note in notes:
        # A field's own bounds are objects with one attribute each, those of a list's items are a FieldInfo.
        for one in (note, *getattr(note, "metadata", ())):
            for name, _ in _BOUNDS:
                value = getattr(one, name, None)
                if isinstance(value, int | float):
                    found[name] = value
    return found


def explain(fault: Mapping[str, Any], model: type[BaseModel]) -> str:
    """Say what a value must be, from one of pydantic's errors.

    Parameters
    ----------
    fault : entry of ``ValidationError.errors()``
    model : what was validated
    """
    kind, context = str(fault["type"]), fault.get("ctx", {})
    if kind.startswith(("greater_than", "less_than")):
        limits = {**_limits(model, fault["loc"]), **context}
        bounds = [f"{word} {limits[name]:.10g}" for name, word in _BOUNDS if name in limits]
        return "must be " + " and ".join(bounds)
    if kind in _TEMPLATES:
        return _TEMPLATES[kind].format(**context)
    family, _, ending = kind.partition("_")
    if family in _FAMILIES and ending.endswith(("type", "parsing", "number", "float", "unicode")):
        return _FAMILIES[family]
    message: str = fault["msg"]
    return message.removeprefix("Value error, ").removeprefix("Assertion failed, ")
