"""Typed configuration: YAML file, then ``--set a.b=c``, then flags, checked by pydantic.

Used by all three programs. A key that the model does not know is refused with its file and line and the
nearest valid key; a value that does not fit is refused with its key and what was expected.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterator, Mapping, Sequence, Set
from datetime import date
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
)

from mbtf_core.errors import InputError, MbtfError, UsageError, reason
from mbtf_core.nested import deep_merge, leaves, merge, nested
from mbtf_core.suggest import refuse_special, suggest_name, suggest_path
from mbtf_core.validation_messages import explain, models_in, parts_of


class Settings(BaseModel):
    """Base of every configuration section: unknown keys are errors, numbers are finite, values are fixed.

    Attributes
    ----------
    exclusive : class attribute, pairs of dotted keys that a file or a command line must not both give
    """

    exclusive: ClassVar[tuple[tuple[str, str], ...]] = ()
    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True, allow_inf_nan=False)

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


# The name of a file, or a path to it.
FileName = Annotated[str, Field(min_length=1), AfterValidator(_file_name)]

_COMMAND_LINE = "command line"

# Bounds on the length, the depth and (because of YAML's aliases) the number of values of a configuration.
_MAX_CHARACTERS = 1 << 18
_MAX_DEPTH = 100
_MAX_VALUES = 100_000
_TOO_DEEP = f"is nested more than {_MAX_DEPTH} levels deep"
# Tags of plain values.
_TAGS = ("map", "seq", "str", "int", "float", "bool", "null", "timestamp", "binary", "set", "omap")


def _yaml() -> Any:
    from ruamel.yaml import YAML

    return YAML(typ="rt")


def _is_yaml(path: Path) -> bool:
    return path.suffix.lower() in (".yaml", ".yml")


def read_yaml(path: Path) -> Any:
    """Mapping stored in a YAML file, with line numbers kept.

    Raises
    ------
    InputError : the file is missing, unreadable, not YAML, or not a mapping
    """
    from ruamel.yaml.error import MarkedYAMLError

    refuse_special(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError("no such file", where=path, hint=suggest_path(path, _is_yaml)) from None
    except UnicodeDecodeError as error:
        raise InputError(f"is not UTF-8 text (byte {error.start})", where=path) from None
    except (OSError, ValueError) as error:
        raise InputError(f"cannot be read ({getattr(error, 'strerror', error)})", where=path) from None
    if len(text) > _MAX_CHARACTERS:
        raise InputError(f"is too long: more than {_MAX_CHARACTERS:,} characters", where=path)
    if _bracket_depth(text) > _MAX_DEPTH:
        raise InputError(_TOO_DEEP, where=path)
    try:
        data = _yaml().load(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark
        line = f":{mark.line + 1}" if mark is not None else ""
        raise InputError(f"not valid YAML ({reason(error.problem)})", where=f"{path}{line}") from None
    except RecursionError:
        raise InputError(_TOO_DEEP, where=path) from None
    except Exception as error:  # the reader turns scalars into numbers and dates, and may raise anything
        raise InputError(f"not valid YAML ({reason(error)})", where=path) from None
    if data is None:
        return {}
    if not isinstance(data, Mapping):
        raise InputError("must hold a mapping of keys to values", where=path)
    _check_tree(data, path)
    return data


def _bracket_depth(text: str) -> int:
    """How deep brackets are nested: the reader's time grows with the square of it."""
    depth = deepest = 0
    for bracket in re.finditer(r"[\[\]{}]", text):
        depth += 1 if bracket[0] in "[{" else -1
        deepest = max(deepest, depth)
    return deepest


def _check_tree(data: Any, where: object) -> None:
    """Refuse YAML that no configuration contains.

    Raises
    ------
    InputError : nested too deeply, repeated through aliases (or holding itself), keys that are no text, or
        tags of some program's own
    """
    waiting: list[tuple[Any, int]] = [(data, 1)]
    seen = 0
    while waiting:
        value, depth = waiting.pop()
        seen += 1
        if depth > _MAX_DEPTH or seen > _MAX_VALUES:
            what = _TOO_DEEP if depth > _MAX_DEPTH else f"holds more than {_MAX_VALUES:,} values"
            raise InputError(what, where=where, hint="each alias (*name) counts in full")
        tag = getattr(getattr(value, "tag", None), "value", None)
        if tag is not None and str(tag).removeprefix("tag:yaml.org,2002:") not in _TAGS:
            raise InputError(f"holds the tag '{tag}'", where=where, hint="use plain values")
        if isinstance(value, Mapping):
            for key, inner in value.items():
                if not isinstance(key, str):
                    raise InputError(f"key {_shown(key)} is not text", where=where, hint="put it in quotes")
                waiting.append((inner, depth + 1))
        elif isinstance(value, Sequence | Set) and not isinstance(value, str | bytes):
            waiting += ((inner, depth + 1) for inner in value)


def _shown(value: Any) -> str:
    """A value as it was given, shortened to a part of a line."""
    text = str(value) if isinstance(value, date) else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def dump_yaml(data: Mapping[str, Any]) -> str:
    """YAML text of plain data (dicts, lists, strings, numbers), keys in the given order."""
    from ruamel.yaml import YAML

    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = False
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    stream = io.StringIO()
    yaml.dump(dict(data), stream)
    return stream.getvalue()


def _known_keys(model: type[BaseModel], location: Sequence[str | int]) -> list[str]:
    """Valid keys of the section that `location` lies in (the last part is the offending key)."""
    models = [model]
    for part in location[:-1]:
        if isinstance(part, int):
            continue
        fields = [m.model_fields[part] for m in models if part in m.model_fields]
        deeper = [m for f in fields for m in models_in(f.annotation)]
        models = deeper or models
    return sorted({key for m in models for key in m.model_fields})


def _holder(data: Any, key: str) -> Any:
    """The mapping that states a key: `data`, or one that is merged into it (``<<: *name``)."""
    merged = () if key in (data.lc.data or {}) else data.merge
    return next((_holder(one, key) for one in merged if key in one), data)


def line_of(data: Any, location: Sequence[str | int]) -> int | None:
    """Line (from 1) of a key in data that :func:`read_yaml` returned; None where it is not in the file."""
    line = None
    for part in location:
        try:
            if isinstance(part, str) and part not in data:
                continue  # pydantic inserts tags of unions into its locations
            data = _holder(data, part) if isinstance(part, str) else data
            position = data.lc.key(part) if isinstance(part, str) else data.lc.item(part)
            line = position[0] + 1
            data = data[part]
        except (AttributeError, KeyError, IndexError, TypeError):
            break
    return line


def _explain(
    error: ValidationError, model: type[BaseModel], data: Any, source: str, spelled: Mapping[str, str]
) -> tuple[str, str, str]:
    """(where, what, hint) of one fault: an unknown key before others, since it may explain a missing one."""
    faults = error.errors()
    fault = next((f for f in faults if f["type"] == "extra_forbidden"), faults[0])
    location = list(fault["loc"])
    dotted = ".".join(str(p) for p in location) or "(top level)"
    # Data that the command line has changed may still carry the file's line numbers.
    line = None if source == _COMMAND_LINE else line_of(data, location)
    flag = next((f for key, f in spelled.items() if f"{dotted}.".startswith(f"{key}.")), None)
    where = flag or (f"{source}:{line}" if line is not None else source)
    if fault["type"] == "extra_forbidden":
        known = _known_keys(model, location)
        what = f"unknown key '{dotted}'"
        hint = suggest_name(str(location[-1]), known, 0.5) or f"valid keys: {', '.join(known)}"
        return where, what, hint
    if fault["type"] == "missing":
        return where, f"key '{dotted}' is missing", "add it"
    given = fault.get("input")
    shown = "" if isinstance(given, Mapping | BaseModel) else f" (given {_shown(given)})"
    named = f"'{dotted}': " if location else ""
    return where, f"{named}{explain(fault, model)}{shown}", ""


def build(
    model: type[B],
    data: Mapping[str, Any],
    *,
    source: str,
    error: type[MbtfError] = InputError,
    spelled: Mapping[str, str] | None = None,
) -> B:
    """Check `data` against `model`.

    Parameters
    ----------
    source : where the data come from, for messages: a file, "command line"
    error : class of the error to raise
    spelled : dotted key → the flag that gave it, named in place of `source`

    Raises
    ------
    error : with the key, its line where `data` came from :func:`read_yaml`, and the nearest valid key
    """
    try:
        return model.model_validate(data)
    except ValidationError as fault:
        where, what, hint = _explain(fault, model, data, source, spelled or {})
        raise error(what, where=where, hint=hint) from None


def check_schema(document: Mapping[str, Any], version: int, where: object, hint: str) -> None:
    """Refuse a JSON document of the programs that another version of them wrote.

    Raises
    ------
    InputError : with both schema versions
    """
    found = document.get("schema")
    if found != version:
        what = f"has schema version {found}, this program reads version {version}"
        raise InputError(what, where=where, hint=hint)


def check_document(model: type[B], data: Mapping[str, Any], path: object, hint: str) -> B:
    """A JSON document of the programs as `model`.

    Raises
    ------
    InputError : with the first key that is missing or holds something else
    """
    try:
        return build(model, data, source=str(path))
    except InputError as error:
        raise InputError(f"is damaged ({error.what})", where=path, hint=hint) from None


def parse_value(text: str) -> Any:
    """A ``--set`` value, read as YAML reads a scalar."""
    from ruamel.yaml import YAML

    try:
        value = YAML(typ="safe", pure=True).load(text)
    except Exception:  # text that is not YAML is taken as it is; the reader may raise anything
        return text
    _check_tree(value, "--set")
    return value


def _parse_assignment(text: str) -> tuple[str, Any]:
    """(dotted key, value) of ``a.b=c``."""
    key, sign, value = text.partition("=")
    if not sign or not key:
        raise UsageError(f"{_shown(text)} is not of the form key=value", where="--set")
    return key.strip(), parse_value(value)


def _over_presets(presets: Any, key: str, value: Any) -> tuple[str, Any]:
    """An assignment that replaces all of a section but what presets say of it and the assignment does not."""
    for part in key.split("."):
        presets = presets.get(part) if isinstance(presets, Mapping) else None
    both = isinstance(presets, Mapping) and isinstance(value, Mapping)
    return key, deep_merge(presets, value) if both else value


def _contradiction(model: type[Settings], data: Mapping[str, Any]) -> tuple[str, str] | None:
    """The first two keys of nested data that the model declares exclusive, at any depth."""
    given = [key for key, value in leaves(data) if value is not None]
    for key in given:
        for first, second in model.exclusive:
            other = key.removesuffix(first) + second
            if f".{key}".endswith(f".{first}") and other in given:
                return key, other
    return None


def resolve(
    model: type[S],
    *,
    file: Path | None = None,
    presets: Sequence[str] = (),
    assignments: Sequence[str] = (),
    flags: Mapping[str, Any] | None = None,
    spelled: Mapping[str, str] | None = None,
) -> S:
    """Resolved configuration: defaults, then the file, presets, ``a.b=c`` assignments, and flags.

    Parameters
    ----------
    presets : ``a.b=c`` that assignments and flags override, value by value also where one of them gives a
        whole section
    flags : dotted key → value; None values are flags that were not given
    spelled : dotted key → its flag, for messages

    Raises
    ------
    InputError : the file is at fault
    UsageError : an assignment or a flag is at fault
    """
    data: Any = read_yaml(file) if file is not None else {}
    defaults = [_parse_assignment(text) for text in presets]
    own = [_over_presets(nested(dict(defaults)), *_parse_assignment(text)) for text in assignments]
    switches = [(key, value) for key, value in (flags or {}).items() if value is not None]
    given = [*defaults, *own, *switches]
    names = {key: flag for key, flag in (spelled or {}).items() if (flags or {}).get(key) is not None}
    both = _contradiction(model, nested(dict(own) | {key: value for key, value in switches if key in names}))
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
    for key, value in given:
        merge(data, key.split("."), value)
    return build(model, data, source=_COMMAND_LINE, error=UsageError, spelled=names)


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
