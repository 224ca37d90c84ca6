"""The options of a pydantic model, in Markdown: one list for the model's own keys and one for each nested
section, with key and default, values, and the field's description."""

from __future__ import annotations

import importlib
import inspect
import re
import types
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import annotated_types
from pydantic import BaseModel, TypeAdapter
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from mbtf_core.errors import MbtfError

# What Markdown would read as more than text.
_SPECIAL = re.compile(r"[<$*~\[\]]|\b_|_\b")
_LITERAL = re.compile(r"``(.+?)``|`(.+?)`")
_SCALARS = {bool: "true/false", int: "integer", float: "number", str: "text", Any: "any"}
# Powers of two from here on are written as such.
_LARGE = 1 << 15
# Limits of lengths from here on only guard against files that are none.
_LONG = 100
_BOUNDS = ("ge", "gt", "le", "lt")


@dataclass
class Row:
    """One option, as the list shows it."""

    key: str
    values: str
    meaning: str


@dataclass
class Section:
    """A list: the keys whose value it describes, and its rows."""

    keys: list[str]
    text: str
    rows: list[Row] = field(default_factory=list)


def _arguments(annotation: Any) -> tuple[Any, list[Any]]:
    """An annotation without ``Annotated`` and ``None``, and what ``Annotated`` said."""
    said: list[Any] = []
    while True:
        if get_origin(annotation) is Annotated:
            annotation, *more = get_args(annotation)
            said += more
        elif get_origin(annotation) in (Union, types.UnionType):
            kept = [a for a in get_args(annotation) if a is not type(None)]
            if len(kept) != 1:
                return annotation, said
            annotation = kept[0]
        else:
            return annotation, said


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    """Models that values of an annotation hold."""
    annotation, _ = _arguments(annotation)
    if inspect.isclass(annotation) and issubclass(annotation, BaseModel):
        yield annotation
    else:
        for inner in get_args(annotation):
            yield from _models(inner)


def _kind(annotation: Any) -> str:
    """A type in words."""
    annotation, _ = _arguments(annotation)
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return ", ".join(f"`{_value(v)}`" for v in inner)
    if origin in (Union, types.UnionType):
        return " or ".join(_kind(a) for a in inner if a is not type(None))
    if origin in (list, Sequence) or (origin is tuple and inner[-1] is Ellipsis):
        return f"list of {_plural(_kind(inner[0]))}"
    if origin is tuple:
        return f"{len(inner)} {_plural(_kind(inner[0]))}"
    if origin in (dict, Mapping):
        return "mapping"
    if inspect.isclass(annotation) and issubclass(annotation, BaseModel):
        return "section"
    return _SCALARS.get(annotation, getattr(annotation, "__name__", str(annotation)))


def _plural(kind: str) -> str:
    return kind if kind.startswith("`") or " or " in kind else f"{kind.removesuffix('s')}s"


def _value(value: Any) -> str:
    """A value as YAML writes it, in short."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int) and value >= _LARGE and value & (value - 1) == 0:
        return f"2^{value.bit_length() - 1}"
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{k}: {_value(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_value(v) for v in value) + "]"
    return str(value) if value != "" else '""'


def _plain_default(info: FieldInfo) -> Any:
    """A default in JSON's types, durations and sizes in the form in which they are written."""
    value = info.get_default(call_default_factory=True)
    annotated: Any = Annotated[info.annotation, *info.metadata] if info.metadata else info.annotation
    return TypeAdapter(annotated).dump_python(value, mode="json")


def _found_bounds(info: FieldInfo) -> dict[str, Any]:
    """Limits of a number, as pydantic names them, and the largest ``length`` of a short list."""
    said, inside = list(info.metadata), info.annotation
    inside, more = _arguments(inside)
    said += more
    if get_origin(inside) in (list, tuple) and len({*get_args(inside)} - {Ellipsis}) == 1:
        said += [FieldInfo.from_annotation(get_args(inside)[0])]
    out: dict[str, Any] = {}
    for limit in said:
        if isinstance(limit, FieldInfo):
            out |= _found_bounds(limit)
        elif isinstance(limit, annotated_types.MaxLen):
            out |= {"length": limit.max_length} if limit.max_length < _LONG else {}
        else:
            out |= {name: n for name in _BOUNDS if (n := getattr(limit, name, None)) is not None}
    return out


def _range(info: FieldInfo) -> str:
    """Limits as an interval, a comparison, or the largest length."""
    found = _found_bounds(info)
    out = [f"length ≤ {found.pop('length')}"] if "length" in found else []
    limits = {name: _value(number) for name, number in found.items()}
    if len(limits) == 2:
        low, high = (limits.get(name, limits.get(other)) for name, other in (("ge", "gt"), ("le", "lt")))
        out.insert(0, f"{'[' if 'ge' in limits else '('}{low}, {high}{']' if 'le' in limits else ')'}")
    else:
        signs = dict(zip(_BOUNDS, "≥>≤<", strict=True))
        out = [f"{signs[name]} {number}" for name, number in limits.items()] + out
    return ", ".join(out)


def _row(prefix: str, name: str, info: FieldInfo) -> Row:
    kind = _kind(info.annotation)
    # A number that is written with its unit, such as 2min or 4GB.
    if (
        not info.is_required()
        and kind in ("number", "integer", "TimeBudget")
        and isinstance(_plain_default(info), str)
    ):
        kind = "number with unit"
    key, values = f"{prefix}{name}", f"{kind} {_range(info)}".rstrip()
    if info.is_required():
        return Row(key, f"{values}; required", info.description or "")
    if kind in ("true/false", "text", "mapping") or (kind == "section" and info.get_default() is None):
        # The default, the meaning or a list of its own says so.
        values = ""
    if (default := _value(_plain_default(info))) != "null":
        # As `--set` takes it; with spaces, it would need quotes.
        key, values = (key, f"{values}: `{default}`") if " " in default else (f"{key}={default}", values)
    return Row(key, values, info.description or "")


def _is_version(info: FieldInfo) -> bool:
    """The version of the format has one value."""
    return get_origin(info.annotation) is Literal and len(get_args(info.annotation)) == 1


def _is_section(info: FieldInfo) -> bool:
    """A nested model at its own defaults gets a list of its own and no row."""
    value = PydanticUndefined if info.is_required() else info.get_default(call_default_factory=True)
    if not isinstance(value, BaseModel):
        return False
    try:
        return value == type(value)()
    except (ValueError, MbtfError):
        return False


def _text(model: type[BaseModel]) -> str:
    return " ".join((inspect.getdoc(model) or "").split("\n\n")[0].split())


def sections(model: type[BaseModel], only: Sequence[str] = (), skip: Sequence[str] = ()) -> list[Section]:
    """Lists of a model: its own keys, then those of each nested section, depth first."""
    out: list[Section] = []
    _collect(model, [""], only, skip, out)
    return [s for s in out if s.rows]


def _collect(
    model: type[BaseModel], prefixes: list[str], only: Sequence[str], skip: Sequence[str], out: list[Section]
) -> None:
    """Append the lists of a model that lies at each of some dotted prefixes."""
    at = [p for p in prefixes if p]
    section = Section([p.removesuffix(".") for p in at], _text(model))
    out.append(section)
    nested: dict[type[BaseModel], list[str]] = {}
    prefix = prefixes[0] if len(prefixes) == 1 else ""
    for name, info in model.model_fields.items():
        if (only and name not in only) or _is_version(info):
            continue
        inside, skipped = list(_models(info.annotation)), f"{prefix}{name}" in skip
        if not _is_section(info) and (inside or not skipped):
            section.rows.append(_row(prefix, name, info))
        for inner in () if skipped else inside:
            nested.setdefault(inner, []).append(name)
    for inner, names in nested.items():
        _collect(inner, [f"{p}{n}." for p in prefixes for n in names], (), skip, out)


def cell(text: str) -> str:
    """Text of a table's cell; what stands in backquotes is code."""
    parts, end = [], 0
    for found in _LITERAL.finditer(text):
        parts += [_SPECIAL.sub(r"\\\g<0>", text[end : found.start()]), f"`{found[1] or found[2]}`"]
        end = found.end()
    return "".join([*parts, _SPECIAL.sub(r"\\\g<0>", text[end:])]).replace("|", "\\|")


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of cells."""
    lines = [" ".join(f"| {text}" if text else "|" for text in line) + " |" for line in (header, *rows)]
    return "\n".join([lines[0], "|---" * len(header) + "|", *lines[1:]])


def _line(row: Row) -> str:
    values = f" ({cell(row.values)})" if row.values else ""
    return f"- `{row.key}`{values}" + (f": {cell(row.meaning)}" if row.meaning else "")


def configuration(name: str, only: Sequence[str] = (), skip: Sequence[str] = ()) -> str:
    """The lists of a model with this dotted name.

    Parameters
    ----------
    only : keys of the model that are shown; all by default
    skip : dotted keys that are documented elsewhere; of a section, its own options
    """
    module, _, attribute = name.rpartition(".")
    parts = []
    for section in sections(getattr(importlib.import_module(module), attribute), only, skip):
        if section.keys:
            keys = ", ".join(f"**`{key}`**" for key in section.keys)
            parts.append(f"{keys}: {cell(section.text)}" if section.text else keys)
        parts.append("\n".join(map(_line, section.rows)))
    return "\n\n".join(parts)
