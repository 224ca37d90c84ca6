"""Options as nested mappings and by dotted names."""

from __future__ import annotations

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
