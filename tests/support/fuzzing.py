"""Corrupted files for hypothesis; a loader loads them or refuses them in one or two lines."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Mapping
from typing import Any

from hypothesis import strategies as st

from mbtf_core.errors import MbtfError

# Bytes that headers are sensitive to.
_BYTES = st.one_of(st.sampled_from([0, 1, 2, 8, 16, 127, 128, 254, 255]), st.integers(0, 255))
# Values that replace those of a JSON document.
_VALUES = ["null", "[]", "{}", '""', '"x"', '"../x.npz"', "-1", "0", "9" * 30, "1e300", "1.5", "true", "[[]]"]


def check_message(error: MbtfError) -> None:
    """A message fit to print: one or two lines of printable text, not too long."""
    lines = error.message.splitlines()
    assert 1 <= len(lines) <= 2, error.message
    assert all(len(line) < 400 and line.isprintable() for line in lines), repr(error.message)
    assert error.what.strip(), repr(error.message)


def loads_or_refuses(load: Callable[[], Any]) -> Any:
    """What `load` returns; None where it raises one of the project's errors, with a message fit to print."""
    try:
        return load()
    except MbtfError as error:
        check_message(error)
        return None


@st.composite
def damaged(draw: st.DrawFn, samples: Mapping[str, bytes]) -> tuple[str, bytes]:
    """(name, content) of one of the samples with a few bytes changed, mostly early ones, maybe cut short."""
    name = draw(st.sampled_from(sorted(samples)))
    content = bytearray(samples[name])
    reach = draw(st.sampled_from([40, 150, 400, len(content)]))
    place = st.integers(0, min(reach, len(content)) - 1)
    for at, value in draw(st.lists(st.tuples(place, _BYTES), max_size=6)):
        content[at] = value
    if draw(st.integers(0, 5)) == 0:
        del content[draw(st.integers(0, len(content))) :]
    return name, bytes(content)


def with_checksums(png: bytes) -> bytes:
    """A damaged PNG file whose chunks have the right checksums, so that decoders look further."""
    out, at = png[:8], 8
    while at + 12 <= len(png):
        end = at + 8 + int.from_bytes(png[at : at + 4], "big")
        if end + 4 > len(png):
            break
        out += png[at:end] + zlib.crc32(png[at + 4 : end]).to_bytes(4, "big")
        at = end + 4
    return out + png[at:]


@st.composite
def altered(draw: st.DrawFn, document: str) -> str:
    """JSON text of `document` with one to three of its values replaced or left out."""
    data = json.loads(document)
    for _ in range(draw(st.integers(1, 3))):
        places = list(_places(data))
        if not places:
            break
        holder, key = places[draw(st.integers(0, len(places) - 1))]
        if draw(st.booleans()):
            holder[key] = json.loads(draw(st.sampled_from(_VALUES)))
        else:
            del holder[key]
    return json.dumps(data)


def _places(data: Any) -> list[tuple[Any, Any]]:
    """(container, key) of every value in nested data."""
    out = []
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in items:
        out.append((data, key))
        out += _places(value)
    return out
