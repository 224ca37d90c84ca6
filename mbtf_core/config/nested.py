"""Options as nested mappings and by dotted names, and how two of them differ."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any


def merge(base: Any, path: Sequence[str], value: Any) -> None:
    """Set ``base[path[0]][path[1]]… = value`` in nested mappings, making sections as needed."""
    for part in path[:-1]:
        if not isinstance(base.get(part), Mapping):
            base[part] = {}
        base = base[part]
    base[path[-1]] = value


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
