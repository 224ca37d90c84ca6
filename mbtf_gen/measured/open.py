"""Which reader a file or folder is for, by its content."""

from __future__ import annotations

from pathlib import Path

from mbtf_core.errors import InputError
from mbtf_core.paths import opened
from mbtf_gen.measured.hdf5 import COLOR, MAGIC, RADIUS, NeumipQueries, NeuralBtf, hdf5_file
from mbtf_gen.measured.interface import MeasuredBtf
from mbtf_gen.measured.ubo2003 import Ubo2003
from mbtf_gen.measured.ubo2014 import Ubo2014

_ZIP = b"PK"
# Other archives, and single compressed files.
_PACKED = (b"Rar!", b"7z\xbc\xaf", b"\x1f\x8b", b"BZh", b"\xfd7zXZ", b"\x28\xb5\x2f\xfd")
_KNOWN = (
    "a .btf file (Bonn, DFMF), a folder or zip of photographs named by angles, or HDF5 of NeuMIP or NeuralBTF"
)
# The first bytes, which tell what a file is.
_START = 1 << 10


def open_measured(path: str | Path) -> MeasuredBtf | NeumipQueries:
    """Open a measured BTF or a data set of another program.

    Raises
    ------
    InputError : the file is missing, of no known kind, or damaged
    """
    path = Path(path)
    if path.is_dir():
        return Ubo2003(path)
    with opened(path) as stream:
        start = stream.read(_START)
    if start.startswith(b"!"):
        return Ubo2014(path)
    if start.startswith(_ZIP):
        return Ubo2003(path)
    if not start.startswith(MAGIC):
        raise _unknown(path, start)
    with hdf5_file(path) as file:
        names = set(file)
    if COLOR not in names:
        raise InputError(f"is an HDF5 file without '{COLOR}'", where=path, hint=f"known are {_KNOWN}")
    return NeumipQueries(path) if RADIUS in names or "ground_valid" in names else NeuralBtf(path)


def _unknown(path: Path, start: bytes) -> InputError:
    """What a file is that no reader is for."""
    text = start.removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if not start:
        return InputError("is empty", where=path, hint="download it again")
    if text.startswith((b"<!doctype", b"<html", b"<?xml")):
        return InputError("is a web page, not a measured BTF", where=path, hint="download the file again")
    if start.startswith(_PACKED):
        return InputError("is an archive that is not read", where=path, hint="unpack it and give the folder")
    return InputError("is not a measured BTF of a known kind", where=path, hint=f"known are {_KNOWN}")
