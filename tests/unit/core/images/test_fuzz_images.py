"""Damaged images and false claims of size: loaded, or refused in a line or two, with little memory."""

from __future__ import annotations

import io
import json
import resource
import struct
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from support.fuzzing import damaged, loads_or_refuses, with_checksums
from support.image_samples import bmps, exrs, jpgs, npys, packed_png, pngs, tgas, tiffs

from mbtf_core.images.read import read_image


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Room for one damaged file at a time."""
    return tmp_path_factory.mktemp("images")


@pytest.fixture(scope="module")
def samples(folder: Path) -> dict[str, dict[str, bytes]]:
    """Suffix → name → content."""
    out = {"png": pngs(), "jpg": jpgs(), "tif": tiffs(), "npy": npys(), "exr": exrs(folder)}
    return {**out, "tga": tgas(), "bmp": bmps()}


def read(folder: Path, name: str, content: bytes) -> None:
    """Read a file of that content."""
    path = folder / f"damaged{Path(name).suffix}"
    path.write_bytes(content)
    image = loads_or_refuses(lambda: read_image(path))
    if image is not None:
        assert image.pixels.ndim == 3
        assert 1 <= image.pixels.shape[2] <= 4
        assert np.isfinite(image.pixels).all()


@pytest.mark.parametrize("kind", ["png", "jpg", "tif", "npy", "exr", "tga", "bmp"])
@given(data=st.data())
@settings(max_examples=200)
def test_a_damaged_image(
    kind: str, data: st.DataObject, samples: dict[str, dict[str, bytes]], folder: Path
) -> None:
    name, content = data.draw(damaged(samples[kind]))
    if kind == "png" and data.draw(st.booleans()):
        content = with_checksums(content)
    read(folder, name, content)


def test_damaged_pixels_of_tiff_files_are_read_in_silence(
    samples: dict[str, dict[str, bytes]], folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for name, content in samples["tif"].items():
        for at in (int(share * len(content)) for share in (0.3, 0.6, 0.9)):
            read(folder, name, content[:at] + bytes([content[at] ^ 0x55]) + content[at + 1 :])
    assert capfd.readouterr() == ("", "")


SIDE = 60_000
# MiB that reading all of them may take: of memory (a library loads tables, but no picture), and of addresses
# (threads reserve some without using them; a claim of 60000 x 60000 asks for 3400 at least).
ALLOWED, ADDRESSES = 100, 1000

# Reads each file; then message what came of it and by how much the peak of memory rose, in MiB. The limit on
# addresses makes sure that memory taken and never touched counts as well.
_CODE = """
import json, resource, sys
from pathlib import Path
import numpy, OpenEXR, PIL.Image, tifffile
from mbtf_core.errors import MbtfError
from mbtf_core.images.read import read_image
from mbtf_core.data.shard_files import read_shard
allowed = int(sys.argv[2])
read_image(sys.argv[3])
size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (size + allowed * 2**20, resource.RLIM_INFINITY))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
found = {}
for path in sorted(Path(sys.argv[1]).iterdir()):
    try:
        if path.name.startswith("shard"):
            for mapped in (True, False):
                read_shard(path, mapped=mapped)
        else:
            read_image(path)
        found[path.name] = "was read"
    except MbtfError as error:
        found[path.name] = error.what
rise = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024
print(json.dumps([rise, found]))
"""


def _tiff(side: int) -> bytes:
    """A TIFF file whose directory claims another size."""
    stream = io.BytesIO()
    Image.new("L", (8, 8)).save(stream, "TIFF")
    content = bytearray(stream.getvalue())
    for tag in (256, 257):
        entry = struct.pack("<HHI", tag, 4, 1)
        at = content.index(entry) + len(entry)
        content[at : at + 4] = struct.pack("<I", side)
    return bytes(content)


def _jpg(side: int) -> bytes:
    """A JPG file whose frame header claims another size."""
    stream = io.BytesIO()
    Image.new("L", (8, 8)).save(stream, "JPEG")
    content = bytearray(stream.getvalue())
    at = content.index(b"\xff\xc0") + 5
    content[at : at + 4] = side.to_bytes(2, "big") * 2
    return bytes(content)


def _npy(descr: str, shape: str) -> bytes:
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(64)


def _exr(folder: Path, **changes: bytes) -> bytes:
    """An EXR file with the content of some of its header's attributes exchanged."""
    import OpenEXR

    path = folder / "made.exr"
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"Y": np.zeros((8, 8), np.float32)}).write(str(path))
    content = bytearray(path.read_bytes())
    for name, value in changes.items():
        at = content.index(name.encode() + b"\0") + len(name) + 1
        at = content.index(b"\0", at) + 5  # behind the type and the size
        content[at : at + len(value)] = value
    return bytes(content)


def write_claims(folder: Path, beside: Path) -> dict[str, str]:
    """Files that claim more than they hold; name → text of the refusal."""
    lines = zlib.compress(bytes(100_000))
    huge = struct.pack("<4i", 0, 0, SIDE - 1, SIDE - 1)
    claims: dict[str, tuple[bytes, str]] = {
        "gray.png": (packed_png(SIDE, SIDE, 8, 0, lines), "claims 60000 x 60000 pixels"),
        "cap.png": (packed_png(11000, 11000, 8, 6, lines), "cannot hold 11000 x 11000 pixels"),
        "side.jpg": (_jpg(SIDE), "claims 60000 x 60000 pixels"),
        "side.tif": (_tiff(SIDE), "claims 60000 x 60000 pixels"),
        "cap.tif": (_tiff(11000), "cannot hold 11000 x 11000 pixels"),
        "side.npy": (_npy("'<f4'", f"({SIDE}, {SIDE})"), "cannot be read as an npy array"),
        "pickle.npy": (_npy("'|O'", "(4, 4)"), "cannot be read as an npy array"),
        "lines.exr": (_exr(beside, dataWindow=huge, displayWindow=huge), "claims 60000 x 60000 pixels"),
        "shard.exr": (_exr(beside, dataWindow=huge, displayWindow=huge), "claims 60000 x 60000 pixels"),
        "shard.npz": (_bomb(), "shard is compressed"),
    }
    for name, (content, _) in claims.items():
        (folder / name).write_bytes(content)
    return {name: message for name, (_, message) in claims.items()}


def _bomb() -> bytes:
    """A hundred megabytes of zeros in a few kilobytes."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as out:
        out.writestr("sigma.npy", _npy("'<f4'", "(25000000,)")[:-64] + bytes(100_000_000))
    return stream.getvalue()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_claims_take_no_memory(tmp_path: Path) -> None:
    folder = tmp_path / "claims"
    folder.mkdir()
    expected = write_claims(folder, tmp_path)
    Image.new("L", (8, 8)).save(tmp_path / "small.tif")
    assert max(path.stat().st_size for path in folder.iterdir()) < 200_000
    child = subprocess.run(
        [sys.executable, "-c", _CODE, str(folder), str(ADDRESSES), str(tmp_path / "small.tif")],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CORE, (0, 0)),
    )
    assert child.returncode == 0, child.stderr
    # Nothing but the answer: no remark of a decoder.
    assert child.stderr == ""
    rise, found = json.loads(child.stdout)
    for name, message in expected.items():
        assert message in found[name], (name, found[name])
        # Refused by what it claims, not because memory ran out.
        assert "memory" not in found[name].lower(), (name, found[name])
    assert rise < ALLOWED, found
