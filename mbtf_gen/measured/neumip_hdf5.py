"""Data sets of NeuMIP (Kuznetsov et al. 2021, "NeuMIP: multi-resolution neural materials"), as HDF5.

The program straintensor/NeuMIP writes and reads these. They have N images of H x W unrelated queries; the
images have no meaning of their own. Its numbers are of half precision, ours of single precision:

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
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_core.files.atomic import write_through
from mbtf_gen.measured.hdf5 import data_set, floats, opened
from mbtf_gen.measured.interface import F32, HORIZON, QueryBlock, from_plane

COLOR, PLACE, RADIUS = "ground_color", "ground_camera_target_loc", "ground_camera_query_radius"
VIEW, LIGHT, OTHER_LIGHT = "ground_camera_dir", "ground_light", "ground_light_dir"
# Most queries of an image, which is read as a whole.
_MOST_OF_IMAGE = 1 << 24
_CHANNELS = {COLOR: 3, PLACE: 2, RADIUS: 1, VIEW: 2, LIGHT: 2}


class NeumipQueries:
    """An opened file; see :class:`~mbtf_gen.measured.interface.MeasuredQueries`.

    Attributes
    ----------
    count : int
        Queries of the file.
    base_radius : float or None
        Sigma of the finest level in tile widths; None where neither the file nor its shape says it.
    """

    def __init__(self, path: Path, shape: tuple[int, ...], light: str, base_radius: float | None) -> None:
        self.path, self.base_radius = path, base_radius
        self._light = light
        self._each = math.prod(shape[1:])
        self.count = shape[0] * self._each

    def read(self, start: int, stop: int) -> QueryBlock:
        """Queries from `start` to before `stop`, those left out that cannot be used."""
        start, stop = max(start, 0), min(stop, self.count)
        number = np.arange(start, max(start, stop), dtype=np.int64)
        with opened(self.path) as file:
            part = {
                name: self._part(
                    data_set(file, self._light if name == LIGHT else name, self.path), start, stop
                )
                for name in _CHANNELS
            }
        with np.errstate(over="ignore", invalid="ignore"):
            u = np.mod(0.5 * (part[PLACE] + 1.0), 1.0).astype(np.float32)
            u[u >= 1.0] = 0.0
            sigma = part[RADIUS][:, 0]
            if self.base_radius is not None:
                sigma = np.where(sigma == 0.0, self.base_radius, sigma)
            out = QueryBlock(
                query=number,
                u=u,
                sigma=sigma.astype(np.float32),
                omega_i=from_plane(-part[LIGHT]),
                omega_o=from_plane(-part[VIEW]),
                value=part[COLOR].astype(np.float32),
            )
        return _usable(out)

    def _part(self, found: Any, start: int, stop: int) -> NDArray[np.float64]:
        """Rows (stop - start, channels) of a data set."""
        channels = found.shape[-1]
        if math.prod(found.shape[:-1]) != self.count:
            raise InputError("has changed while it was read", where=self.path)
        if stop <= start:
            return np.empty((0, channels))
        first, last = start // self._each, -(-stop // self._each)
        rows = floats(found, first, last).reshape(-1, channels)
        return rows[start - first * self._each : stop - first * self._each]


def _usable(queries: QueryBlock) -> QueryBlock:
    ok = (queries["sigma"] > 0) & np.isfinite(queries["sigma"])
    for array in (queries["u"], queries["value"], queries["omega_i"], queries["omega_o"]):
        ok &= np.isfinite(array).all(axis=-1)
    for omega in (queries["omega_i"], queries["omega_o"]):
        ok &= omega[:, 2] > HORIZON
    if ok.all():
        return queries
    return QueryBlock(
        query=queries["query"][ok],
        u=queries["u"][ok],
        sigma=queries["sigma"][ok],
        omega_i=queries["omega_i"][ok],
        omega_o=queries["omega_o"][ok],
        value=queries["value"][ok],
    )


def read_neumip(path: str | Path) -> NeumipQueries:
    """Open a data set of NeuMIP; its numbers stay on disk.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    NeumipQueries

    Raises
    ------
    InputError
        Not HDF5, a data set is missing or has another shape, or it is the rendering of a scene.
    """
    path = Path(path)
    with opened(path) as file:
        if "ground_valid" in file:
            raise InputError("is the rendering of a scene (it has 'ground_valid'), not queries", where=path)
        light = LIGHT if LIGHT in file or OTHER_LIGHT not in file else OTHER_LIGHT
        shape: tuple[int, ...] | None = None
        for name, channels in _CHANNELS.items():
            stored = light if name == LIGHT else name
            found = data_set(file, stored, path).shape
            shape = found[:-1] if shape is None else shape
            if len(found) not in (2, 3, 4) or found != (*shape, channels):
                raise InputError(
                    f"has the shape {found} of '{stored}'; {(*shape, channels)} is expected", where=path
                )
        assert shape is not None
        if math.prod(shape[1:]) > _MOST_OF_IMAGE:
            raise InputError(f"has images of more than {_MOST_OF_IMAGE:,} queries", where=path)
        base = file.attrs.get("base_radius")
    if base is None:
        return NeumipQueries(path, shape, light, 0.5 / shape[2] if len(shape) == 3 else None)
    try:
        radius = float(base)
    except (TypeError, ValueError):
        radius = math.nan
    if not 0.0 < radius < math.inf:
        raise InputError("has an attribute 'base_radius' that is not a positive number", where=path)
    return NeumipQueries(path, shape, light, radius)


def write_neumip(
    path: str | Path,
    batches: Iterable[Mapping[str, NDArray[Any]]],
    resolution: int,
    image: tuple[int, int] = (512, 512),
) -> int:
    """Write queries as a data set that NeuMIP trains from.

    Parameters
    ----------
    path : str or Path
        It is replaced only once all queries are written.
    batches : iterable of mappings
        ``u``, ``sigma``, ``omega_i``, ``omega_o`` and ``value`` in our conventions, of any number of queries
        at a time. All must be finite, with directions above the horizon.
    resolution : int
        Texels across the tile at the finest level, for ``base_radius``.
    image : (int, int)
        Rows and columns that queries are arranged in: NeuMIP trains on whole images. The queries should be in
        random order.

    Returns
    -------
    int
        Queries written. The last ones that do not fill an image are left out.

    Raises
    ------
    InputError
        Queries are invalid, or fewer than fill an image.
    """
    path = Path(path)
    each = image[0] * image[1]
    if min(image) < 1 or each > _MOST_OF_IMAGE:
        raise InputError(f"images of {image[0]} x {image[1]} queries are not written", where=path)
    written = 0

    def write(temporary: Path) -> None:
        nonlocal written
        import h5py

        with h5py.File(temporary, "w") as file:
            file.attrs["base_radius"] = 0.5 / resolution
            stored = {
                name: file.create_dataset(
                    name, (0, *image, c), np.float32, maxshape=(None, *image, c), chunks=(1, *image, c)
                )
                for name, c in _CHANNELS.items()
            }
            waiting = {name: np.empty((0, c), np.float32) for name, c in _CHANNELS.items()}
            for batch in batches:
                rows = _theirs(batch, path)
                waiting = {name: np.concatenate([waiting[name], rows[name]]) for name in waiting}
                images = len(waiting[COLOR]) // each
                if not images:
                    continue
                done = written // each
                for name, array in waiting.items():
                    stored[name].resize(done + images, axis=0)
                    stored[name][done:] = array[: images * each].reshape(images, *image, -1)
                waiting = {name: array[images * each :] for name, array in waiting.items()}
                written += images * each
            if not written:
                count = len(waiting[COLOR])
                raise InputError(f"{count:,} queries do not fill an image of {each:,}", where=path)

    write_through(path, write)
    return written


def _theirs(batch: Mapping[str, NDArray[Any]], path: Path) -> dict[str, F32]:
    """Our queries in their conventions."""
    count = len(batch["sigma"])
    for name, shape in {"u": (2,), "sigma": (), "omega_i": (3,), "omega_o": (3,), "value": (3,)}.items():
        array = batch[name]
        if array.shape != (count, *shape) or not np.isfinite(array).all():
            raise InputError(
                f"'{name}' has the shape {array.shape} or numbers that are not finite", where=path
            )
        if name.startswith("omega") and count and array[:, 2].min() <= HORIZON:
            raise InputError(f"'{name}' has directions at the horizon or below it", where=path)
    if count and batch["sigma"].min() <= 0:
        raise InputError("'sigma' has numbers that are not positive", where=path)
    place = 2.0 * batch["u"].astype(np.float64) - 1.0
    return {
        COLOR: batch["value"].astype(np.float32),
        PLACE: place.astype(np.float32),
        RADIUS: batch["sigma"].astype(np.float32)[:, None],
        VIEW: -batch["omega_o"][:, :2].astype(np.float32),
        LIGHT: -batch["omega_i"][:, :2].astype(np.float32),
    }
