"""An npz archive as consecutive chunks, so that a digest can be computed while it is written."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

# Offsets of arrays are multiples of this, so that mapped arrays are aligned.
ALIGNMENT = 64
# Bytes of a local header without name and extra fields, and of the extra field of 64-bit sizes (APPNOTE.TXT
# 6.3.3, sections 4.3.7 and 4.5.3).
_HEADER, _SIZES_64 = 30, 20


class _Chunks:
    """A stream that collects what is written to it. It cannot seek, so that no chunk changes later."""

    def __init__(self) -> None:
        self.pending: list[bytes | memoryview] = []

    def write(self, data: bytes | memoryview) -> int:
        self.pending.append(data)
        return memoryview(data).nbytes

    def flush(self) -> None:
        pass

    def close(self) -> None:
        pass

    def take(self) -> list[bytes | memoryview]:
        out, self.pending = self.pending, []
        return out


def _npy_header(array: NDArray[np.float32]) -> bytes:
    stream = io.BytesIO()
    npy_format.write_array_header_1_0(stream, npy_format.header_data_from_array_1_0(array))
    return stream.getvalue()


def npz_chunks(arrays: Iterable[tuple[str, NDArray[np.float32]]]) -> Iterator[bytes | memoryview]:
    """The bytes of an npz archive of C-ordered arrays, by name and in their order."""
    chunks = _Chunks()
    position = 0
    with zipfile.ZipFile(chunks, "w") as archive:
        for name, array in arrays:
            head = _npy_header(array)
            # The default date is the earliest of the format, so the bytes depend on the arrays alone.
            info = zipfile.ZipInfo(f"{name}.npy")
            info.create_system = 3
            padding = -(position + _HEADER + len(info.filename) + _SIZES_64 + 4) % ALIGNMENT
            info.extra = b"MT" + padding.to_bytes(2, "little") + bytes(padding)
            with archive.open(info, "w", force_zip64=True) as member:
                member.write(head)
                member.write(array.reshape(-1).view(np.uint8).data)
            for chunk in chunks.take():
                position += memoryview(chunk).nbytes
                yield chunk
    yield from chunks.take()
