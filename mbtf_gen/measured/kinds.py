"""The known kinds of measured files, and which of them a file is."""

from __future__ import annotations

from pathlib import Path

from mbtf_core.errors import InputError
from mbtf_core.paths import opened
from mbtf_gen.measured.hdf5 import COLOR, MAGIC, NeumipQueries, hdf5_file
from mbtf_gen.measured.interface import MeasuredBtf
from mbtf_gen.measured.ubo2003 import Ubo2003
from mbtf_gen.measured.ubo2014 import Ubo2014

_KNOWN = "a .btf file (Bonn, DFMF), a folder or zip of photographs named by angles, or HDF5 of NeuMIP"


def open_measured(path: str | Path) -> MeasuredBtf | NeumipQueries:
    """Open a measured BTF or a data set of another program; an InputError if the file is missing, of no known
    kind, or damaged."""
    path = Path(path)
    if path.is_dir():
        return Ubo2003(path)
    with opened(path) as stream:
        start = stream.read(len(MAGIC))
    if start.startswith(b"!"):
        return Ubo2014(path)
    if start.startswith(b"PK"):
        return Ubo2003(path)
    if not start.startswith(MAGIC):
        what = "is not a measured BTF of a known kind"
        raise InputError(what, where=path, hint=f"download or unpack it again; known are {_KNOWN}")
    with hdf5_file(path) as file:
        names = set(file)
    if COLOR not in names:
        raise InputError(f"is an HDF5 file without '{COLOR}'", where=path, hint=f"known are {_KNOWN}")
    return NeumipQueries(path)
