"""YAML files: read with line numbers and within bounds, and written."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence, Set
from datetime import date
from pathlib import Path
from typing import Any

from mbtf_core.errors import InputError, reason
from mbtf_core.paths import refuse_special, suggest_path

# Bounds on the length, the depth and (because of YAML's aliases) the number of values of a configuration.
_MAX_CHARACTERS = 1 << 17
# The reader takes up to a millisecond for each line, colon and comma, and for each key that is merged (<<).
_MAX_MARKS = 10_000
_MAX_MERGED = 200_000
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
    """Mapping stored in a YAML file, with line numbers kept; an InputError where the file is missing,
    unreadable, not YAML, or not a mapping."""
    from ruamel.yaml.error import MarkedYAMLError
    from ruamel.yaml.reader import ReaderError

    text = _text_of(path)
    marks = sum(text.count(mark) for mark in ("\n", ":", ","))
    if len(text) > _MAX_CHARACTERS or marks > _MAX_MARKS:
        what = f"more than {_MAX_CHARACTERS:,} characters, or {_MAX_MARKS:,} lines, colons and commas"
        raise InputError(f"is too long: {what}", where=path)
    if "<<" in text and text.count("*") * marks > _MAX_MERGED:
        raise InputError("merges (<<) too many keys", where=path)
    bracket = _deep_bracket(text)
    if bracket is not None:
        raise InputError(_TOO_DEEP, where=_place(path, text, bracket))
    try:
        data = _yaml().load(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark
        line = f":{mark.line + 1}" if mark is not None else ""
        hint = "in double quotes, a backslash begins an escape: write slashes" * (
            "escape" in str(error.problem)
        )
        raise InputError(
            f"not valid YAML ({reason(error.problem)})", where=f"{path}{line}", hint=hint
        ) from None
    except ReaderError as error:
        what = f"has the control character U+{ord(text[error.position]):04X}"
        where = _place(path, text, error.position)
        raise InputError(what, where=where, hint="save it as UTF-8 text") from None
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


def _text_of(path: Path) -> str:
    """Text of a file, at most about as much as is read of a configuration; an InputError where it is missing,
    unreadable or not UTF-8."""
    refuse_special(path)
    try:
        with path.open("rb") as stream:
            # A character takes at most four bytes.
            content = stream.read(4 * _MAX_CHARACTERS + 4)
    except FileNotFoundError:
        raise InputError("no such file", where=path, hint=suggest_path(path, _is_yaml)) from None
    except (OSError, ValueError) as error:
        raise InputError(f"cannot be read ({getattr(error, 'strerror', error)})", where=path) from None
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if len(content) > 4 * _MAX_CHARACTERS:
            raise InputError("is too long for a configuration", where=path) from None
        line = content.count(b"\n", 0, error.start) + 1
        what, where = f"is not UTF-8 text (byte {error.start})", f"{path}:{line}"
        raise InputError(what, where=where, hint="save it as UTF-8 text") from None


def _place(path: Path, text: str, position: int) -> str:
    line = text.count("\n", 0, position) + 1
    return f"{path}:{line}"


def _deep_bracket(text: str) -> int | None:
    """Where brackets are nested too deeply: the reader's time grows with the square of their depth."""
    depth = 0
    for bracket in re.finditer(r"[\[\]{}]", text):
        depth += 1 if bracket[0] in "[{" else -1
        if depth > _MAX_DEPTH:
            return bracket.start()
    return None


def _check_tree(data: Any, where: object) -> None:
    """Refuse YAML that no configuration contains: nested too deeply, repeated through aliases (or holding
    itself), keys that are no text, or tags of some program's own."""
    # Each value with its depth and the line of the last key on the way to it.
    waiting: list[tuple[Any, int, int | None]] = [(data, 1, None)]
    seen = 0
    while waiting:
        value, depth, line = waiting.pop()
        place = where if line is None else f"{where}:{line}"
        seen += 1
        if depth > _MAX_DEPTH or seen > _MAX_VALUES:
            what = _TOO_DEEP if depth > _MAX_DEPTH else f"holds more than {_MAX_VALUES:,} values"
            raise InputError(what, where=place, hint="each alias (*name) counts in full")
        tag = getattr(getattr(value, "tag", None), "value", None)
        if tag is not None and str(tag).removeprefix("tag:yaml.org,2002:") not in _TAGS:
            raise InputError(f"holds the tag '{tag}'", where=place, hint="use plain values")
        if isinstance(value, Mapping):
            lines = getattr(getattr(value, "lc", None), "data", None) or {}
            for key, inner in value.items():
                own = lines[key][0] + 1 if key in lines else line
                if not isinstance(key, str):
                    raise InputError(
                        f"key {shortened(key)} is not text",
                        where=where if own is None else f"{where}:{own}",
                        hint="put it in quotes",
                    )
                waiting.append((inner, depth + 1, own))
        elif isinstance(value, Sequence | Set) and not isinstance(value, str | bytes):
            waiting += ((inner, depth + 1, line) for inner in value)


def shortened(value: Any) -> str:
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


def parse_value(text: str) -> Any:
    """A ``--set`` value, read as YAML reads a scalar."""
    from ruamel.yaml import YAML

    try:
        value = YAML(typ="safe", pure=True).load(text)
    except Exception:  # text that is not YAML is taken as it is; the reader may raise anything
        return text
    _check_tree(value, "--set")
    return value


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
