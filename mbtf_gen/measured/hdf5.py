"""Data sets of NeuMIP as HDF5. Files are untrusted.

NeuMIP (Kuznetsov et al. 2021, "NeuMIP: multi-resolution neural materials"). The
program straintensor/NeuMIP writes and reads these. They have N images of H x W unrelated queries; the images
have no meaning of their own. Its numbers are of half precision, ours of single precision:

- ``ground_color`` (N, H, W, 3): radiance under a directional light of irradiance 1 across its direction,
  divided by the cosine of the light. This is our value: radiance under an irradiance of 1 on the plane.
- ``ground_camera_target_loc`` (N, H, W, 2): x and y on the plane in [-1, 1]; the tile is 2 wide.
- ``ground_camera_query_radius`` (N, H, W, 1): in tile widths. The file's attribute ``base_radius`` is that of
  the finest level: half a texel, as is our sigma, the standard deviation of a Gaussian. Which kernel its
  renderer applies is not part of the published source. Files that were made from measured BTFs have 0, which
  is read as ``base_radius`` or as half a texel of an image.
- ``ground_camera_dir``, ``ground_light`` (N, H, W, 2): x and y of the directions in which the camera looks
  and the light travels, z < 0: the opposites of ours. Another writer calls the latter ``ground_light_dir``.
- ``ground_valid``: in renderings of scenes only, which are refused: their pixels are no queries.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.shard_files import Arrays
from mbtf_core.errors import InputError, MbtfError, reason
from mbtf_core.extras import import_extra
from mbtf_gen.measured.interface import COMPLETE, HORIZON, from_plane

MAGIC = b"\x89HDF\r\n\x1a\n"
COLOR, VIEW, LIGHT = "ground_color", "ground_camera_dir", "ground_light"
PLACE, RADIUS = "ground_camera_target_loc", "ground_camera_query_radius"
_OTHER_LIGHT = "ground_light_dir"
# Numbers of a query of NeuMIP.
CHANNELS = {COLOR: 3, PLACE: 2, RADIUS: 1, VIEW: 2, LIGHT: 2}
# Most queries of an image of NeuMIP, which is read as a whole.
MOST_OF_IMAGE = 1 << 22
# Largest chunk, which is the least that the library decompresses at a time.
_MOST_CHUNK_BYTES = 1 << 28
# Largest size of the numbers of a data set: as a ratio to the size of the file, and what any file may have.
_MOST_RATIO, _ANY_FILE_BYTES = 100, 1 << 26


@contextmanager
def hdf5_file(path: Path) -> Iterator[Any]:
    """The h5py file of a path; whatever the library raises within becomes an InputError."""
    h5py = import_extra("h5py", path)
    try:
        # A chunk that images share is decompressed once.
        with h5py.File(path, "r", rdcc_nbytes=_MOST_CHUNK_BYTES) as file:
            yield file
    except MbtfError:
        raise
    except Exception as error:  # a damaged file may make the library raise anything
        raise InputError(f"cannot be read as HDF5 ({reason(error)})", where=path, hint=COMPLETE) from None


def data_set(file: Any, name: str, path: Path) -> Any:
    """A data set of floats in the root of a file, with every number stored in this file; else an
    InputError."""
    h5py = import_extra("h5py", path)
    found = file[name] if isinstance(file.get(name, getlink=True), h5py.HardLink) else None
    if not isinstance(found, h5py.Dataset) or found.is_virtual or found.external:
        names = ", ".join(sorted(file)[:10])
        hint = f"it has {names}" if names else "it is empty"
        raise InputError(f"has no data set '{name}' of its own", where=path, hint=hint)
    if found.dtype.kind != "f" or found.dtype.itemsize not in (2, 4, 8):
        raise InputError(f"has {found.dtype} numbers in '{name}'; floats are expected", where=path)
    if not found.shape or min(found.shape) < 1:
        raise InputError(f"has the shape {found.shape} of '{name}'", where=path)
    size, stored = found.size * found.dtype.itemsize, path.stat().st_size
    if size > _MOST_RATIO * stored + _ANY_FILE_BYTES:
        what = f"claims {size:,} bytes of '{name}' in a file of {stored:,}"
        raise InputError(what, where=path, hint=COMPLETE)
    if found.chunks is None:
        unit, total, stored = "bytes", found.size * found.dtype.itemsize, found.id.get_storage_size()
    else:
        if math.prod(found.chunks) * found.dtype.itemsize > _MOST_CHUNK_BYTES:
            raise InputError(f"has chunks {found.chunks} of '{name}', which are too large", where=path)
        total = math.prod(-(-n // c) for n, c in zip(found.shape, found.chunks, strict=True))
        unit, stored = "chunks", found.id.get_num_chunks()
    if stored != total:
        raise InputError(f"stores {stored:,} of the {total:,} {unit} of '{name}'", where=path)
    return found


def floats(found: Any, start: int, stop: int) -> NDArray[np.float64]:
    """Numbers of the first axis from `start` to before `stop`; those beyond the range become infinite."""
    with np.errstate(invalid="ignore"):
        return np.asarray(found[start:stop]).astype(np.float64)


class NeumipQueries:
    """A data set of NeuMIP, opened; its numbers stay on disk.

    Attributes
    ----------
    count : queries of the file
    base_radius : sigma of the finest level in tile widths; None where neither the file nor its shape says it
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with hdf5_file(path) as file:
            if "ground_valid" in file:
                what = "is the rendering of a scene (it has 'ground_valid'), not queries"
                raise InputError(what, where=path)
            self._light = LIGHT if LIGHT in file or _OTHER_LIGHT not in file else _OTHER_LIGHT
            shape: tuple[int, ...] | None = None
            for name, channels in CHANNELS.items():
                stored = self._light if name == LIGHT else name
                found = data_set(file, stored, path).shape
                shape = found[:-1] if shape is None else shape
                if len(found) not in (2, 3, 4) or found != (*shape, channels):
                    raise InputError(
                        f"has the shape {found} of '{stored}'; {(*shape, channels)} is expected", where=path
                    )
            assert shape is not None
            base = file.attrs.get("base_radius", 0.5 / shape[2] if len(shape) == 3 else None)
        self._each = math.prod(shape[1:])
        self.count = shape[0] * self._each
        if self._each > MOST_OF_IMAGE:
            raise InputError(f"has images of more than {MOST_OF_IMAGE:,} queries", where=path)
        try:
            self.base_radius = None if base is None else float(base)
        except (TypeError, ValueError):
            self.base_radius = math.nan
        if self.base_radius is not None and not 0.0 < self.base_radius < math.inf:
            raise InputError("has an attribute 'base_radius' that is not a positive number", where=path)

    def read(self, start: int, stop: int) -> Arrays:
        """Queries from `start` to before `stop`: ``u``, ``sigma``, ``omega_i``, ``omega_o`` and ``value`` in
        our conventions. Left out are NaN or infinite numbers, directions at the horizon or below it, and
        footprints without size."""
        stop = min(stop, self.count)
        with hdf5_file(self.path) as file:
            part = {
                name: self._part(
                    data_set(file, self._light if name == LIGHT else name, self.path), start, stop
                )
                for name in CHANNELS
            }
        with np.errstate(over="ignore", invalid="ignore"):
            u = np.mod(0.5 * (part[PLACE] + 1.0), 1.0).astype(np.float32)
            u[u >= 1.0] = 0.0
            sigma = part[RADIUS][:, 0]
            if self.base_radius is not None:
                sigma = np.where(sigma == 0.0, self.base_radius, sigma)
            out: Arrays = {
                "u": u,
                "sigma": sigma.astype(np.float32),
                "omega_i": from_plane(-part[LIGHT]),
                "omega_o": from_plane(-part[VIEW]),
                "value": part[COLOR].astype(np.float32),
            }
        ok = (out["sigma"] > 0) & np.isfinite(out["sigma"])
        for array in (out["u"], out["value"], out["omega_i"], out["omega_o"]):
            ok &= np.isfinite(array).all(axis=-1)
        ok &= np.minimum(out["omega_i"][:, 2], out["omega_o"][:, 2]) > HORIZON
        return {name: array[ok] for name, array in out.items()}

    def _part(self, found: Any, start: int, stop: int) -> NDArray[np.float64]:
        """Rows (stop - start, channels) of a data set."""
        channels = found.shape[-1]
        if math.prod(found.shape[:-1]) != self.count:
            raise InputError("has changed while it was read", where=self.path)
        first, last = start // self._each, -(-stop // self._each)
        rows = floats(found, first, last).reshape(-1, channels)
        return rows[start - first * self._each : stop - first * self._each]
