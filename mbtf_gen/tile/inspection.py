"""The statistics of a tile, which :meth:`Tile.inspect` collects, as text."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

# Width to which long texts are wrapped, and lines of the longest list.
_WIDTH, _MOST_LINES = 100, 24
# Sentences among the statistics, and what repeats them.
_TEXTS = ("material", "notes", "warnings", "scale_warning", "unused")


def inspection_text(found: Mapping[str, Any], name: str) -> str:
    """Statistics of a tile as text: name, value and unit of each, then notes and warnings."""
    numbers = {key: value for key, value in found.items() if key not in _TEXTS}
    flat = {key: value for key, value in numbers.items() if not _is_nested(value)}
    lines = [f"{name} (lengths in tile widths)"]
    for key, value in {"tile": flat, **{k: v for k, v in numbers.items() if k not in flat}}.items():
        lines += _lines(key, value)
    # The most important one comes last.
    scale = found.get("scale_warning")
    warnings = brief_warnings(w for w in found["warnings"] if w != scale)
    for title, texts in (
        ("note", found["notes"]),
        ("warning", [*warnings, *(brief_warnings([scale]) if scale else ())]),
    ):
        for text in texts:
            lines += _wrapped(f"{title}: ", text)
    return "\n".join(lines)


def brief_warnings(warnings: Iterable[str]) -> list[str]:
    """Warnings without the folders of their files."""
    parts = (text.partition(": ") for text in warnings)
    return [f"{Path(path).name}: {rest}" for path, _, rest in parts]


def _is_nested(value: Any) -> bool:
    """Whether a value takes lines of its own."""
    if isinstance(value, list | tuple):
        return any(isinstance(item, Mapping | list | str) for item in value)
    return isinstance(value, Mapping)


def _lines(name: str, value: Any) -> Iterator[str]:
    """A section's numbers in a line, and its sections below it."""
    if isinstance(value, Mapping):
        known = {key: item for key, item in value.items() if item is not None and item != ()}
        flat = [f"{key} {_shown(item)}" for key, item in known.items() if not _is_nested(item)]
        if flat:
            yield from _wrapped(f"{name:<14} ", ", ".join(flat))
        for key, item in known.items():
            if _is_nested(item):
                yield from _lines(f"{name}.{key}", item)
    elif len(value) > _MOST_LINES:
        yield f"{name:<14} {len(value)} items; --json prints them"
    else:
        for number, item in enumerate(value, 1):
            if _is_nested(item):
                yield from _lines(f"{name}.{number}", item)
            else:
                yield f"{name:<14} {item}"


def _shown(value: Any) -> str:
    if isinstance(value, list | tuple):
        return " ".join(map(_shown, value))
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _wrapped(head: str, text: str) -> list[str]:
    """Lines of a text behind its head, all of them indented by the width of the head."""
    return textwrap.wrap(text, _WIDTH, initial_indent=head, subsequent_indent=" " * len(head))
