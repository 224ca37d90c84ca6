"""Typed configuration: YAML file, then ``--set a.b=c``, then flags, checked by pydantic.

Used by all three programs. A key that the model does not know is refused with its file and line and the
nearest valid key; a value that does not fit is refused with its key and what was expected.
"""

from __future__ import annotations

import os
import re
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self, TypeVar, Union

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
)

from mbtf_core.config.yaml_file import line_of, parse_value, read_yaml, shortened
from mbtf_core.errors import InputError, MbtfError, UsageError
from mbtf_core.paths import named_file, suggest_name

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)

_COMMAND_LINE = "command line"
Read = Callable[[Path], Any]


def parts_of(annotation: Any, *, containers: bool = True) -> list[Any]:
    """The types within an annotation's Optional, unions and `containers` (lists and dicts), without
    metadata."""
    origin = typing.get_origin(annotation)
    if origin is Annotated:
        return parts_of(typing.get_args(annotation)[0], containers=containers)
    if origin in (Union, types.UnionType) or (containers and origin in (list, tuple, dict)):
        inner = typing.get_args(annotation)
        return [part for each in inner for part in parts_of(each, containers=containers)]
    return [annotation]


class _Checked(ModelMetaclass):
    """Makes configurations whose faults are an InputError of one line; sections within are made by pydantic,
    which collects theirs."""

    if not TYPE_CHECKING:

        def __call__(cls, *values: object, **options: object) -> Any:
            if values:
                first = next(key for key in cls.model_fields if key != "version")
                hint = f"such as {cls.__name__}({first}=...)"
                raise InputError("takes named values only", where=cls.__name__, hint=hint)
            return build(cls, options, source=cls.__name__)


class Settings(BaseModel, metaclass=_Checked):
    """Base of every configuration section: unknown keys are errors, numbers are finite, values are fixed.

    Making one, or its ``model_validate``, raises an :class:`InputError` for a value or a key that is wrong.

    Attributes
    ----------
    exclusive : class attribute, pairs of dotted keys that a file or a command line must not both give; one of
        a command line replaces the other of file and presets
    """

    exclusive: ClassVar[tuple[tuple[str, str], ...]] = ()
    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True, allow_inf_nan=False)

    @classmethod
    def model_validate(cls, obj: Any) -> Self:  # type: ignore[override]
        return build(cls, obj, source=cls.__name__)

    def __setattr__(self, name: str, value: Any) -> None:
        kind = type(self).__name__
        raise InputError(f"'{name}' cannot be changed", where=kind, hint=f"make another {kind}")

    @field_validator("*", mode="before")
    @classmethod
    def _no_boolean_numbers(cls, value: Any, info: ValidationInfo) -> Any:
        """Spell out true and false where a number is wanted: pydantic would read them as 1 and 0."""
        kinds = parts_of(cls.model_fields[str(info.field_name)].annotation)
        numeric = (int in kinds or float in kinds) and bool not in kinds
        return _spelled_out(value) if numeric else value


def _spelled_out(value: Any) -> Any:
    # The YAML reader's boolean with an anchor is no bool.
    if isinstance(value, bool) or type(value).__name__ == "ScalarBoolean":
        return "true" if value else "false"
    if isinstance(value, list | tuple):
        return [_spelled_out(item) for item in value]
    return value


B = TypeVar("B", bound=BaseModel)
S = TypeVar("S", bound=Settings)


def _file_name(name: str) -> str:
    try:
        usable = "\0" not in name and all(len(os.fsencode(part)) <= 255 for part in name.split("/"))
    except UnicodeError:
        usable = False
    if not usable or len(name) > 4000:
        raise ValueError("is not a valid file name")
    return name


def _path_text(name: Any) -> Any:
    return os.fspath(name) if isinstance(name, os.PathLike) else name


# The name of a file, or a path to it.
FileName = Annotated[str, BeforeValidator(_path_text), Field(min_length=1), AfterValidator(_file_name)]


def _separated(name: str) -> str:
    path = named_file(Path(), name)
    return name if path == Path(name) else str(path)


# The same, relative to the current folder.
LocalName = Annotated[FileName, AfterValidator(_separated)]


def distinct(values: list[Any]) -> list[Any]:
    """The same values; a ValueError if two are equal."""
    if any(value in values[:i] for i, value in enumerate(values)):
        raise ValueError("contains the same entry twice")
    return values


def _models_in(parts: Iterable[Any]) -> list[type[BaseModel]]:
    return [k for k in parts if isinstance(k, type) and issubclass(k, BaseModel)]


def _models_at(model: type[BaseModel], location: Sequence[str | int]) -> list[type[BaseModel]]:
    """Models of the section at `location`; names of a dict and numbers of a list are skipped."""
    models = [model]
    for name in location:
        fields = [m.model_fields[str(name)] for m in models if name in m.model_fields]
        models = _models_in(part for f in fields for part in parts_of(f.annotation)) or models
    return models


def _keys_below(model: type[BaseModel]) -> Iterator[str]:
    """Dotted keys of a model and its sections."""
    for name, field in model.model_fields.items():
        yield name
        for section in _models_in(parts_of(field.annotation, containers=False)):
            yield from (f"{name}.{key}" for key in _keys_below(section))


def _suggest_key(model: type[BaseModel], location: Sequence[str | int]) -> str:
    """Hint at a key of the same name in the nearest section, or at the key of this section that is meant."""
    *sections, name = map(str, location)
    for depth in range(len(sections), -1, -1):
        for key in (k for m in _models_at(model, sections[:depth]) for k in _keys_below(m)):
            if key.rpartition(".")[2] == name:
                return f"did you mean '{'.'.join([*sections[:depth], key])}'?"
    known = sorted({key for m in _models_at(model, sections) for key in m.model_fields})
    return suggest_name(name, known, 0.5) or f"valid keys: {', '.join(known)}"


def _explain(
    error: ValidationError, model: type[BaseModel], data: Any, source: str, spelled: Mapping[str, str]
) -> tuple[str, str, str]:
    """(where, what, hint) of one fault: an unknown key before others, since it may explain a missing one."""
    faults = error.errors()
    fault = next((f for f in faults if f["type"] == "extra_forbidden"), faults[0])
    location = list(fault["loc"])
    dotted = ".".join(str(p) for p in location)
    # Data that the command line has changed may still carry the file's line numbers.
    line = None if source == _COMMAND_LINE else line_of(data, location)
    flag = next((f for key, f in spelled.items() if f"{dotted}.".startswith(f"{key}.")), None)
    where = flag or (f"{source}:{line}" if line is not None else source)
    if fault["type"] == "extra_forbidden":
        return where, f"unknown key '{dotted}'", _suggest_key(model, location)
    if fault["type"] == "missing":
        return where, f"key '{dotted}' is missing", "add it"
    if fault["type"] == "model_type":
        keys = dict.fromkeys(key for m in _models_at(model, location) for key in m.model_fields)
        what = f"'{dotted}' must be a section of keys (given {shortened(fault['input'])})"
        return where, what, f"valid keys: {', '.join(keys)}"
    what = fault["msg"].removeprefix("Value error, ").replace("Input should", "must")
    given = fault["input"]
    shown = "" if isinstance(given, Mapping | BaseModel) else f" (given {shortened(given)})"
    return where, (f"'{dotted}': " if dotted else "") + what + shown, ""


def build(
    model: type[B],
    data: Mapping[str, Any],
    *,
    source: str,
    error: type[MbtfError] = InputError,
    spelled: Mapping[str, str] | None = None,
    context: Any = None,
) -> B:
    """Check `data` against `model`; an `error` with the key, its line where `data` came from
    :func:`read_yaml`, and the nearest valid key. It names the source, such as a file, or the flag that gave a
    dotted key (`spelled`); `context` is for the validators of the model."""
    try:
        return typing.cast(B, model.__pydantic_validator__.validate_python(data, context=context))
    except ValidationError as fault:
        where, what, hint = _explain(fault, model, data, source, spelled or {})
        raise error(what, where=where, hint=hint) from None


def check_schema(document: Mapping[str, Any], version: int, where: object, hint: str) -> None:
    """Refuse a JSON document of the programs that another version of them wrote, with both schema
    versions."""
    found = document.get("schema")
    if found != version:
        what = f"has schema version {found}, this program reads version {version}"
        raise InputError(what, where=where, hint=hint)


def check_document(model: type[B], data: Mapping[str, Any], path: object, hint: str) -> B:
    """A JSON document of the programs as `model`; an InputError with the first key that is missing or holds
    something else."""
    try:
        return build(model, data, source=str(path))
    except InputError as error:
        raise InputError(f"is damaged ({error.what})", where=path, hint=hint) from None


def parse_assignment(text: str) -> tuple[str, Any]:
    """(dotted key, value) of ``a.b=c``; a UsageError for another form."""
    key, sign, value = text.partition("=")
    if not sign or not key.strip():
        raise UsageError(f"{shortened(text)} is not of the form key=value", where="--set")
    return key.strip(), parse_value(value)


def _over_presets(presets: Any, key: str, value: Any) -> tuple[str, Any]:
    """An assignment that replaces all of a section but what presets say of it and the assignment does not."""
    for part in key.split("."):
        presets = presets.get(part) if isinstance(presets, Mapping) else None
    both = isinstance(presets, Mapping) and isinstance(value, Mapping)
    return key, deep_merge(presets, value) if both else value


def _excluded(model: type[Settings], data: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Keys of nested data, and what the model declares exclusive to each, at any depth."""
    given = [key for key, value in leaves(data) if value is not None]
    for mine, other in (*model.exclusive, *(pair[::-1] for pair in model.exclusive)):
        for key in given:
            if f".{key}".endswith(f".{mine}"):
                yield key, key.removesuffix(mine) + other


def _contradiction(model: type[Settings], data: Mapping[str, Any]) -> tuple[str, str] | None:
    """The first two keys of nested data that the model declares exclusive."""
    found = dict(_excluded(model, data))
    return next(((key, other) for key, other in found.items() if other in found), None)


def explicit_options(file: Path | None, assignments: Sequence[str], read: Read = read_yaml) -> dict[str, Any]:
    """Options of a configuration file and of ``a.b=c``, nested; single values of the latter as text. An
    InputError where the file cannot be read, a UsageError for an assignment of another form."""
    given = {} if file is None else dict(read(file))
    for text in assignments:
        key, parsed = parse_assignment(text)
        value = parsed if isinstance(parsed, Mapping) else text.partition("=")[2].strip()
        merge(given, key.split("."), value)
    return given


def resolve(
    model: type[S],
    *,
    file: Path | None = None,
    presets: Mapping[str, Any] | None = None,
    assignments: Sequence[str] = (),
    flags: Mapping[str, Any] | None = None,
    spelled: Mapping[str, str] | None = None,
    read: Read = read_yaml,
) -> S:
    """Resolved configuration: defaults, then the file, presets, ``a.b=c`` assignments, and flags.

    Parameters
    ----------
    presets : dotted key → value; assignments and flags override them, value by value also where one of them
        gives a whole section
    flags, spelled : dotted key → value, None where it was not given; its flag, for messages
    read : reads the file

    Raises
    ------
    InputError, UsageError : the file, or an assignment or a flag is at fault
    """
    data: Any = read(file) if file is not None else {}
    switches = [(key, value) for key, value in (flags or {}).items() if value is not None]
    names = {key: flag for key, flag in (spelled or {}).items() if (flags or {}).get(key) is not None}
    said = nested(dict(map(parse_assignment, assignments)) | dict(switches))
    replaced = {other for _, other in _excluded(model, said)}
    defaults = {key: value for key, value in (presets or {}).items() if key not in replaced}
    own = [_over_presets(nested(defaults), *parse_assignment(text)) for text in assignments]
    given = [*defaults.items(), *own, *switches]
    both = _contradiction(model, said)
    if both:
        raise UsageError(
            " and ".join(names.get(key, f"'{key}'") for key in both) + " are mutually exclusive",
            hint="give one of them",
        )
    if file is not None:
        both = _contradiction(model, data)
        # A resolved configuration, which states its version, holds every key.
        if both and "version" not in data:
            what = f"'{both[0]}' and '{both[1]}' are mutually exclusive"
            line = max(line_of(data, key.split(".")) or 1 for key in both)
            raise InputError(what, where=f"{file}:{line}", hint="give one of them")
        # Report errors of the file as such, also where the command line supplies a key that it lacks.
        for key, value in given:
            if key in model.model_fields and model.model_fields[key].is_required() and key not in data:
                data[key] = value
        resolved = build(model, data, source=str(file))
        if not given:
            return resolved
    for key in replaced:
        _remove(data, key.split("."))
    for key, value in given:
        merge(data, key.split("."), value)
    return build(model, data, source=_COMMAND_LINE, error=UsageError, spelled=names)


def merge(base: Any, path: Sequence[str], value: Any) -> None:
    """Set ``base[path[0]][path[1]]… = value`` in nested mappings, making sections as needed."""
    for part in path[:-1]:
        if not isinstance(base.get(part), Mapping):
            base[part] = {}
        base = base[part]
    base[path[-1]] = value


def _remove(base: Any, path: Sequence[str]) -> None:
    """Remove ``base[path[0]][path[1]]…`` of nested mappings, where it is."""
    for part in path[:-1]:
        base = base.get(part) if isinstance(base, Mapping) else None
    if isinstance(base, Mapping):
        base.pop(path[-1], None)  # type: ignore[attr-defined]


def nested(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options by dotted name as nested mappings."""
    out: dict[str, Any] = {}
    for name, value in options.items():
        merge(out, name.split("."), value)
    return out


def deep_merge(base: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """A new mapping: `base`, overridden by `given` section by section."""
    out = dict(base)
    for key, value in given.items():
        under = out.get(key)
        if isinstance(under, Mapping) and isinstance(value, Mapping):
            value = deep_merge(under, value)
        out[key] = value
    return out


def leaves(data: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted name, value) of nested data."""
    for key, value in data.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def differences(old: Mapping[str, Any], new: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Fields in which two nested mappings differ, as ``key: old -> new``; settings before digests of files.

    Digests are shortened to their first eight digits.
    """
    changed = list(_changed(old, new, prefix))
    changed.sort(key=lambda change: any(_is_digest(value) for value in change[1:]))
    return [f"{key}: {_brief(before)} -> {_brief(after)}" for key, before, after in changed]


def in_short(changes: Sequence[str], most: int = 6) -> str:
    """The first of :func:`differences` on one line, with a count of the others."""
    more = [f"and {len(changes) - most} more"] if len(changes) > most else []
    return "; ".join([*changes[:most], *more])


def _changed(old: Mapping[str, Any], new: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any, Any]]:
    for key in sorted({*old, *new}):
        a, b = old.get(key), new.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            yield from _changed(a, b, f"{prefix}{key}.")
        elif a != b:
            yield f"{prefix}{key}", a, b


def _is_digest(value: Any) -> bool:
    return isinstance(value, str) and re.fullmatch(r"[0-9a-f]{64}", value) is not None


def _brief(value: Any) -> str:
    if value is None:
        return "unset"
    return f"{value[:8]}…" if _is_digest(value) else str(value)
