"""Sphinx directive ``configuration``: tables of the options of a pydantic model.

In a page of Markdown::

    ```{configuration} mbtf_fit.config.FitConfig
    :only: training
    :skip: training.blur
    ```

prints one table for the model's own keys and one for each nested section: key, type, default, range, and
the field's description. ``only`` keeps the named top-level keys, ``skip`` lists keys whose own options are
documented elsewhere; both are separated by blanks.
"""

from __future__ import annotations

import importlib
import inspect
import re
import types
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal, Union, get_args, get_origin

import annotated_types
from docutils import nodes
from docutils.parsers.rst import directives
from pydantic import BaseModel, TypeAdapter
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

_HEADER = ("Key", "Type", "Default", "Range", "Meaning")
_LITERAL = re.compile(r"``(.+?)``|`(.+?)`")
_SCALARS = {bool: "true or false", int: "whole number", float: "number", str: "text", Any: "any"}
# Powers of two from here on are written as such.
_LARGE = 1 << 15
_BOUNDS = (("ge", "≥"), ("gt", ">"), ("le", "≤"), ("lt", "<"))


@dataclass
class Row:
    """One option, as the table shows it."""

    key: str
    kind: str
    default: str
    bounds: str
    meaning: str


@dataclass
class Section:
    """A table: the keys whose value it describes, and its rows."""

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
        return " or ".join(f"`{_value(v)}`" for v in inner)
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


def _default(info: FieldInfo) -> str:
    return "required" if info.is_required() else f"`{_value(_plain_default(info))}`"


def _found_bounds(info: FieldInfo) -> list[str]:
    """The limits of a number, or of the length of a list."""
    said, inside = list(info.metadata), info.annotation
    inside, more = _arguments(inside)
    said += more
    if get_origin(inside) in (list, tuple) and len({*get_args(inside)} - {Ellipsis}) == 1:
        said += [FieldInfo.from_annotation(get_args(inside)[0])]
    out: list[str] = []
    for limit in said:
        if isinstance(limit, FieldInfo):
            out += _found_bounds(limit)
        elif isinstance(limit, annotated_types.MinLen | annotated_types.MaxLen):
            least = isinstance(limit, annotated_types.MinLen)
            length = limit.min_length if isinstance(limit, annotated_types.MinLen) else limit.max_length
            if not (least and length <= 1):
                out.append(f"length {'≥' if least else '≤'} {length}")
        else:
            for name, sign in _BOUNDS:
                number = getattr(limit, name, None)
                if number is not None:
                    out.append(f"{sign} {_value(number)}")
    return out


def _row(prefix: str, name: str, info: FieldInfo) -> Row:
    kind = _kind(info.annotation)
    # A number that is written with its unit, such as 2min or 4GB.
    if (
        not info.is_required()
        and kind in ("number", "whole number")
        and isinstance(_plain_default(info), str)
    ):
        kind = "number with unit"
    return Row(
        f"{prefix}{name}", kind, _default(info), ", ".join(_found_bounds(info)), info.description or ""
    )


def _is_section(info: FieldInfo) -> bool:
    """A nested model at its own defaults gets a table of its own and no row."""
    value = PydanticUndefined if info.is_required() else info.get_default(call_default_factory=True)
    if not isinstance(value, BaseModel):
        return False
    try:
        return value == type(value)()
    except ValueError:
        return False


def _text(model: type[BaseModel]) -> str:
    return " ".join((inspect.getdoc(model) or "").split("\n\n")[0].split())


def sections(model: type[BaseModel], only: Sequence[str] = (), skip: Sequence[str] = ()) -> list[Section]:
    """Tables of a model: its own keys, then those of each nested section, depth first."""
    out: list[Section] = []
    _collect(model, [""], only, skip, out)
    return [s for s in out if s.rows]


def _collect(
    model: type[BaseModel], prefixes: list[str], only: Sequence[str], skip: Sequence[str], out: list[Section]
) -> None:
    """Append the tables of a model that lies at each of some dotted prefixes."""
    at = [p for p in prefixes if p]
    section = Section([p.removesuffix(".") for p in at], _text(model))
    out.append(section)
    nested: dict[type[BaseModel], list[str]] = {}
    prefix = prefixes[0] if len(prefixes) == 1 else ""
    for name, info in model.model_fields.items():
        if only and name not in only:
            continue
        if not _is_section(info):
            section.rows.append(_row(prefix, name, info))
        if f"{prefix}{name}" in skip:
            continue
        for inner in _models(info.annotation):
            nested.setdefault(inner, []).append(name)
    for inner, names in nested.items():
        _collect(inner, [f"{p}{n}." for p in prefixes for n in names], (), skip, out)


def _inline(text: str) -> list[nodes.Node]:
    """Text with what stands in backquotes as literals."""
    out: list[nodes.Node] = []
    end = 0
    for found in _LITERAL.finditer(text):
        if found.start() > end:
            out.append(nodes.Text(text[end : found.start()]))
        word = found[1] or found[2]
        out.append(nodes.literal(word, word))
        end = found.end()
    if end < len(text):
        out.append(nodes.Text(text[end:]))
    return out


def _cells(cells: Sequence[list[nodes.Node]]) -> nodes.row:
    return nodes.row("", *(nodes.entry("", nodes.paragraph("", "", *cell)) for cell in cells))


def _table(rows: Sequence[Row]) -> nodes.table:
    group = nodes.tgroup(cols=len(_HEADER))
    group += [nodes.colspec(colwidth=width) for width in (22, 18, 12, 12, 36)]
    group += nodes.thead("", _cells([[nodes.Text(title)] for title in _HEADER]))
    body = [
        [
            [nodes.literal(row.key, row.key)],
            *(_inline(text) for text in (row.kind, row.default, row.bounds, row.meaning)),
        ]
        for row in rows
    ]
    group += nodes.tbody("", *(_cells(cells) for cells in body))
    return nodes.table("", group, classes=["colwidths-auto"])


class ConfigurationDirective(SphinxDirective):
    """``configuration``; see the module."""

    required_arguments = 1
    option_spec: ClassVar[dict[str, Any]] = {"only": directives.unchanged, "skip": directives.unchanged}

    def run(self) -> list[nodes.Node]:
        """The tables.

        Raises
        ------
        docutils.parsers.rst.DirectiveError
            If there is no such model.
        """
        module_name, _, name = self.arguments[0].rpartition(".")
        try:
            module = importlib.import_module(module_name)
            model = getattr(module, name)
        except (ImportError, AttributeError, ValueError) as error:
            raise self.error(f"no pydantic model {self.arguments[0]}: {error}") from None
        self.env.note_dependency(inspect.getfile(model))
        only, skip = (self.options.get(option, "").split() for option in ("only", "skip"))
        out: list[nodes.Node] = []
        for section in sections(model, only, skip):
            if section.keys:
                title: list[nodes.Node] = []
                for key in section.keys:
                    title += [nodes.Text(", "), nodes.literal(key, key)]
                out.append(nodes.rubric("", "", *title[1:]))
                if section.text:
                    out.append(nodes.paragraph("", "", *_inline(section.text)))
            out.append(_table(section.rows))
        return out


def setup(app: Sphinx) -> dict[str, Any]:
    """Called by Sphinx."""
    app.add_directive("configuration", ConfigurationDirective)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
