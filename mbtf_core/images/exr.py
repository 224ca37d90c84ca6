"""Channels and layers of an EXR file, with the size checked before any pixel is read."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError, reason, unwritable
from mbtf_core.files.atomic import Stored, write_through
from mbtf_core.images.limits import check_size
from mbtf_core.paths import suggest_name

# Limit of the numbers in all channels of all parts, in multiples of the largest image.
_MOST_CHANNELS = 4
# Of a number, at most; headers of the library do not tell half from float.
_BYTES = 4
# Tiles may be larger than the image, up to this.
_TILE_PIXELS = 1 << 20
# Channels of one image, in order; Y comes after XYZ, which contains a Y.
_SETS = ("RGB", "XYZ", "Y")
# How far lossy compression may move numbers of [0, 1] out of that range. Measured on noise and edges: DWA at
# its default level 45 by 0.013, in proportion to the level; B44 by 2e-5.
_DWA_LEVEL, _DWA_PER_LEVEL, _DWA_MOST = 45.0, 1e-3, 0.25
_LOSSY = {"B44": 2.0**-10, "B44A": 2.0**-10, "PXR24": 2.0**-15}


@contextlib.contextmanager
def silenced() -> Iterator[None]:
    """Suppress what native libraries print on standard output and standard error."""
    sys.stdout.flush()
    sys.stderr.flush()
    saved = os.dup(1), os.dup(2)
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 1)
        os.dup2(sink, 2)
        # OpenEXR prints through Python's streams as well.
        with open(os.devnull, "w") as no, contextlib.redirect_stdout(no), contextlib.redirect_stderr(no):
            yield
    finally:
        os.dup2(saved[0], 1)
        os.dup2(saved[1], 2)
        for handle in (*saved, sink):
            os.close(handle)


def check_floats(channels: dict[str, NDArray[Any]], path: Path) -> None:
    """Refuse channels of integers."""
    for name, channel in channels.items():
        if channel.dtype.kind != "f":
            raise InputError(f"channel '{name}' stores integers", where=path, hint="save it as half or float")


def read_layers(path: Path, max_pixels: int) -> tuple[dict[str, NDArray[Any]], dict[str, dict[str, Any]]]:
    """Channels (H, W) by name of all parts, float16, float32 or uint32, and the header of each one's part.

    With several parts, the channels of a part carry its name in front, as layers do. An InputError where the
    file is damaged, larger than `max_pixels`, deep, subsampled or cropped (data window unlike the display
    window), or two channels have one name.
    """
    parts = _read(path, max_pixels)
    out: dict[str, NDArray[Any]] = {}
    heads: dict[str, dict[str, Any]] = {}
    for number, (head, channels) in enumerate(parts):
        part = str(head.get("name", f"part{number}"))
        for name, pixels in channels.items():
            full = name if len(parts) == 1 or name.startswith(f"{part}.") else f"{part}.{name}"
            if full in out:
                raise InputError(f"two channels are named '{full}'", where=path)
            out[full], heads[full] = pixels, head
    return out, heads


def lossy_excess(header: Mapping[str, Any]) -> tuple[float, str]:
    """How far the compression of a part may move numbers out of their range, and its name; 0 if exact."""
    name = header["compression"].name.removesuffix("_COMPRESSION")
    if name in ("DWAA", "DWAB"):
        level = float(header.get("dwaCompressionLevel", _DWA_LEVEL))
        return min(_DWA_PER_LEVEL * max(level, _DWA_LEVEL), _DWA_MOST), name
    return (_LOSSY[name], name) if name in _LOSSY else (0.0, "")


def read_parts(path: Path, max_pixels: int) -> dict[str, tuple[dict[str, Any], dict[str, NDArray[Any]]]]:
    """Header and channels (H, W) of every part by its name, float16 or float32; their sizes may differ.
    Errors are those of :func:`read_layers`; parts of one name and channels of integers are refused."""
    out: dict[str, tuple[dict[str, Any], dict[str, NDArray[Any]]]] = {}
    for head, channels in _read(path, max_pixels, cropped=True):
        name = str(head.get("name", ""))
        if name in out:
            raise InputError(f"two parts are named '{name}'", where=path)
        check_floats(channels, path)
        out[name] = head, channels
    return out


def _read(
    path: Path, max_pixels: int, cropped: bool = False
) -> list[tuple[dict[str, Any], dict[str, NDArray[Any]]]]:
    """(header, channels) of every part; all sizes are checked before any pixel is read."""
    import OpenEXR

    broken = InputError("cannot be read as an EXR image: it is damaged or cut short", where=path)
    try:
        with silenced():
            file = OpenEXR.File(os.fspath(path), separate_channels=True, header_only=True)
            heads = [part.header for part in file.parts]
    except Exception:  # a damaged file may make the library raise anything
        raise broken from None
    sizes = [_checked_size(head, path, max_pixels, cropped) for head in heads]
    numbers = sum(h * w * len(head["channels"]) for (h, w), head in zip(sizes, heads, strict=True))
    if numbers > _MOST_CHANNELS * max_pixels:
        raise InputError(
            f"claims {numbers:,} numbers; at most {_MOST_CHANNELS * max_pixels:,} are read", where=path
        )
    if sizes and not cropped:
        check_size(path, *sizes[0], max_pixels, numbers * _BYTES // (sizes[0][0] * sizes[0][1]))
    try:
        with silenced(), OpenEXR.File(os.fspath(path), separate_channels=True) as file:
            parts = [{n: np.asarray(c.pixels) for n, c in part.channels.items()} for part in file.parts]
    except Exception:
        raise broken from None
    if not heads or len(parts) != len(heads):
        raise broken
    for size, channels in zip(sizes, parts, strict=True):
        if not channels or any(c.shape != size for c in channels.values()):
            raise broken
    return list(zip(heads, parts, strict=True))


def _checked_size(head: dict[str, Any], path: Path, max_pixels: int, cropped: bool) -> tuple[int, int]:
    """(rows, columns) of a part; refuses unsupported kinds."""
    import OpenEXR

    if head["type"] not in (OpenEXR.scanlineimage, OpenEXR.tiledimage):
        raise InputError("deep EXR images are not supported", where=path, hint="flatten the image")
    window, shown = (tuple(int(n) for n in np.ravel(head[name])) for name in ("dataWindow", "displayWindow"))
    columns, rows = window[2] - window[0] + 1, window[3] - window[1] + 1
    check_size(path, rows, columns, max_pixels)
    if window != shown and not cropped:
        raise InputError(
            "data window and display window differ: a cropped tile", where=path, hint="crop the image"
        )
    tiles = head["tiles"] if head["type"] == OpenEXR.tiledimage else None
    if tiles is not None and tiles.xSize * tiles.ySize > max(rows * columns, _TILE_PIXELS):
        # The library allocates whole tiles, whatever the size of the image.
        raise InputError(f"claims tiles of {tiles.xSize} x {tiles.ySize} pixels", where=path)
    if any(c.xSampling != 1 or c.ySampling != 1 for c in head["channels"]):
        raise InputError("subsampled EXR channels are not supported", where=path, hint="save it as plain RGB")
    return rows, columns


def write_channels(
    path: Path, channels: Mapping[str, NDArray[np.float32]], header: Mapping[str, Any] | None = None
) -> Stored:
    """Write an uncompressed EXR file of named channels (H, W), atomically, with these attributes; a
    PartialError where the disk is full or the folder cannot be written."""
    import OpenEXR

    head = {"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage, **(header or {})}
    return write_through(
        path, lambda temporary: OpenEXR.File(head, dict(channels)).write(os.fspath(temporary))
    )


def encode_parts(
    parts: Mapping[str, Mapping[str, NDArray[np.float32]]], header: Mapping[str, Any] | None = None
) -> bytes:
    """The bytes of an uncompressed EXR file of several named parts with channels (H, W) by name, each with
    these attributes; a PartialError where the folder for temporary files cannot be written.

    All parts begin in the upper left corner of one display window, which is as large as the largest of them.
    """
    import OpenEXR

    rows, columns = np.max([c.shape for channels in parts.values() for c in channels.values()], axis=0)
    head = {
        "compression": OpenEXR.NO_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        # The format demands that all parts have the same one.
        "displayWindow": (np.zeros(2, np.int32), np.array([columns - 1, rows - 1], np.int32)),
        **(header or {}),
    }
    # The library writes to files only.
    with tempfile.TemporaryDirectory(prefix="mbtf-") as folder:
        path = Path(folder) / "parts.exr"
        try:
            OpenEXR.File([OpenEXR.Part(dict(head), dict(parts[n]), name=n) for n in parts]).write(str(path))
            return path.read_bytes()
        except (RuntimeError, OSError) as error:
            raise unwritable(path, OSError(errno.EIO, reason(error))) from None


def layers(names: list[str]) -> dict[str, list[str]]:
    """Images in a file: label → channels in order.

    ``R G B (A)``, ``X Y Z`` or ``Y (A)`` of one prefix are an image whose label is the prefix (empty for
    none); every other channel is an image by itself, labeled with its whole name.
    """
    out: dict[str, list[str]] = {}
    left = set(names)
    for layer in sorted({n.rpartition(".")[0] for n in names}):
        prefix = f"{layer}." if layer else ""
        base = next((b for b in _SETS if all(prefix + c in left for c in b)), None)
        if base is not None:
            taken = [prefix + c for c in base]
            if base != "XYZ" and f"{prefix}A" in left:
                taken.append(f"{prefix}A")
            out[layer] = taken
            left -= set(taken)
    return {**out, **{name: [name] for name in sorted(left)}}


def choose_channels(
    names: list[str], path: Path, channel: str | None, prefer: Callable[[str], bool] | None = None
) -> list[str]:
    """Channels to read, in order: the channel or layer of that name; else the only image, else the only one
    whose label `prefer` accepts, else the one without a prefix, else the only one of several channels. An
    InputError where there is no such channel, or the choice is unclear."""
    found = layers(names)
    listed = ", ".join(sorted(names))
    if channel is not None:
        if channel in names:
            return [channel]
        if channel in found:
            return found[channel]
        raise InputError(
            f"has no channel or layer '{channel}'",
            where=path,
            hint=suggest_name(channel, [*names, *found], 0.5) or f"it has {listed}",
        )
    if len(found) == 1:
        return next(iter(found.values()))
    preferred = [label for label in found if label and prefer is not None and prefer(label)]
    if len(preferred) == 1:
        return found[preferred[0]]
    if not preferred and "" in found:
        return found[""]
    images = [label for label, channels in found.items() if channels != [label]]
    if not preferred and len(images) == 1:
        return found[images[0]]
    raise InputError(
        f"which of its channels are meant is unclear: {listed}",
        where=path,
        hint="name one in a material.yaml, such as height: {file: "
        f"{path.name}, channel: {next(iter(found))}}}, or keep the channels R, G, B",
    )
