"""An npz archive as consecutive chunks, so that a digest can be computed while it is written.

The records are those of the zip format (PKWARE, APPNOTE.TXT 6.3.3, sections 4.3.7, 4.3.12, 4.3.14-16).
Members are stored uncompressed, with their sizes in the local headers.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

# Offsets of arrays are multiples of this, so that mapped arrays are aligned.
ALIGNMENT = 64

_LOCAL = struct.Struct("<4s5H3I2H")
_CENTRAL = struct.Struct("<4s4B4HL2L5H2L")
_END_64 = struct.Struct("<4sQ2H2L4Q")
_LOCATOR = struct.Struct("<4sLQL")
_END = struct.Struct("<4s4H2LH")
# Version 4.5 reads sizes of 64 bits; the date is the earliest that the format knows.
_VERSION, _UNIX, _DATE = 45, 3, 0x21
_MODE = 0o600 << 16
_IN_64_BITS = 0xFFFFFFFF
# Old readers interpret sizes as signed numbers.
_LARGEST = 0x7FFFFFFF


@dataclass(frozen=True)
class _Member:
    """A member's entry in the central directory."""

    name: bytes
    filler: bytes
    checksum: int
    size: int
    offset: int

    def local(self) -> bytes:
        extra = struct.pack("<2H2Q", 1, 16, self.size, self.size)
        return (
            _LOCAL.pack(
                *(b"PK\3\4", _VERSION, 0, 0, 0, _DATE, self.checksum, _IN_64_BITS, _IN_64_BITS),
                *(len(self.name), len(self.filler) + len(extra)),
            )
            + self.name
            + self.filler
            + extra
        )

    def central(self) -> bytes:
        sizes = [self.size, self.size] if self.size > _LARGEST else []
        offset = [self.offset] if self.offset > _LARGEST else []
        large = [*sizes, *offset]
        extra = struct.pack(f"<2H{len(large)}Q", 1, 8 * len(large), *large) if large else b""
        size = _IN_64_BITS if sizes else self.size
        return (
            _CENTRAL.pack(
                *(b"PK\1\2", _VERSION, _UNIX, _VERSION, 0, 0, 0, 0, _DATE, self.checksum, size, size),
                *(len(self.name), len(extra) + len(self.filler), 0, 0, 0),
                *(_MODE, _IN_64_BITS if offset else self.offset),
            )
            + self.name
            + extra
            + self.filler
        )


def _end(count: int, start: int, size: int) -> bytes:
    """Records at the end of an archive with a central directory of `size` bytes at `start`."""
    if start <= _LARGEST:
        return _END.pack(b"PK\5\6", 0, 0, count, count, size, start, 0)
    return (
        _END_64.pack(b"PK\6\6", 44, _VERSION, _VERSION, 0, 0, count, count, size, start)
        + _LOCATOR.pack(b"PK\6\7", 0, start + size, 1)
        + _END.pack(b"PK\5\6", 0, 0, count, count, size, _IN_64_BITS, 0)
    )


def _npy_header(array: NDArray[np.float32]) -> bytes:
    stream = io.BytesIO()
    npy_format.write_array_header_1_0(stream, npy_format.header_data_from_array_1_0(array))
    return stream.getvalue()


def npz_chunks(arrays: Iterable[tuple[str, NDArray[np.float32]]]) -> Iterator[bytes | memoryview]:
    """The bytes of an npz archive of C-ordered arrays, by name and in their order."""
    position, members = 0, []
    for name, array in arrays:
        numbers: memoryview = array.reshape(-1).view(np.uint8).data
        head, file = _npy_header(array), f"{name}.npy".encode()
        # Local header with 20 bytes of sizes, then an extra field that pads to the alignment.
        padding = -(position + _LOCAL.size + len(file) + 20 + 4) % ALIGNMENT
        filler = b"MT" + padding.to_bytes(2, "little") + bytes(padding)
        checksum = zlib.crc32(numbers, zlib.crc32(head))
        member = _Member(file, filler, checksum, len(head) + len(numbers), position)
        members.append(member)
        local = member.local()
        yield local + head
        yield numbers
        position += len(local) + member.size
    directory = b"".join(member.central() for member in members)
    yield directory + _end(len(members), position, len(directory))
