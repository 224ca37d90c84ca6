"""Captures of mandyxmq/NeuralBTF-release, as HDF5: images of a material under many pairs of light and view.

- ``ground_light``, ``ground_camera_dir`` (N, 2): x and y of unit vectors towards the light and the viewer;
- ``ground_color`` (N, H, W, 3): radiance, linear RGB.

Its documentation says this much. It does not say whether the values include the cosine of the light (the word
is radiance), which unit they have, or that row 0 is the side of positive y, which is assumed here. Captures
with a direction for each pixel, (N, H, W, 2), are another format, which that program refuses as well.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_core.files.atomic import write_through
from mbtf_gen.measured.hdf5 import data_set, floats, opened
from mbtf_gen.measured.interface import (
    F32,
    HORIZON,
    MANY,
    MOST_PAIRS,
    check_finite,
    check_indices,
    check_texels,
    from_plane,
)

COLOR, LIGHT, VIEW = "ground_color", "ground_light", "ground_camera_dir"


class NeuralBtf:
    """An opened capture; see :class:`~mbtf_gen.measured.interface.MeasuredBtf`."""

    cosine = None
    at_once = MANY

    def __init__(self, path: Path, shape: tuple[int, int, int], light: F32, view: F32) -> None:
        self.path = path
        self._shape = shape
        self.rows, self.columns = shape[1:]
        above = (light[:, 2] > HORIZON) & (view[:, 2] > HORIZON)
        self._number = np.flatnonzero(above)
        self.light, self.view, self.left_out = light[above], view[above], int((~above).sum())

    def values(self, pair: NDArray[np.integer[Any]], texel: NDArray[np.integer[Any]]) -> F32:
        """Values (n, 3); of each image the rows between the first and the last texel are read, once."""
        pair, texel = check_indices(pair, texel, len(self._number), self.rows * self.columns)
        out = np.empty((len(pair), 3), np.float32)
        order = np.argsort(pair, kind="stable")
        used, starts = np.unique(pair[order], return_index=True)
        row, column = np.divmod(texel, self.columns)
        with opened(self.path) as file, np.errstate(over="ignore", invalid="ignore"):
            color = data_set(file, COLOR, self.path)
            if color.shape != (*self._shape, 3):
                raise InputError("has changed while it was read", where=self.path)
            for number, group in zip(self._number[used], np.split(order, starts[1:]), strict=True):
                first, last = int(row[group].min()), int(row[group].max())
                part = np.asarray(color[int(number), first : last + 1])
                out[group] = part[row[group] - first, column[group]].astype(np.float32)
        return check_finite(out, self.path)


def read_neural_btf(path: str | Path) -> NeuralBtf:
    """Open a capture; its images stay on disk.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    NeuralBtf

    Raises
    ------
    InputError
        Not HDF5, a data set is missing or has another shape, or a direction is NaN.
    """
    path = Path(path)
    directions = {}
    with opened(path) as file:
        shape = data_set(file, COLOR, path).shape
        if len(shape) != 4 or shape[3] != 3:
            raise InputError(f"has the shape {shape} of '{COLOR}'; (N, H, W, 3) is expected", where=path)
        check_texels(shape[1], shape[2], path)
        if shape[0] > MOST_PAIRS:
            raise InputError(f"claims {shape[0]:,} images", where=path)
        for name in (LIGHT, VIEW):
            found = data_set(file, name, path)
            if found.shape != (shape[0], 2):
                near = found.shape == (*shape[:3], 2)
                raise InputError(
                    f"has the shape {found.shape} of '{name}'; {(shape[0], 2)} is expected",
                    where=path,
                    hint="captures with a direction for each pixel are not read" if near else "",
                )
            xy = floats(found, 0, shape[0])
            if not np.isfinite(xy).all() or (xy * xy).sum(axis=-1).max() > 1.0 + 1e-3:
                raise InputError(f"has numbers in '{name}' that are not x and y of unit vectors", where=path)
            directions[name] = from_plane(xy)
    return NeuralBtf(path, shape[:3], directions[LIGHT], directions[VIEW])


def write_neural_btf(path: str | Path, light: F32, view: F32, images: Iterable[NDArray[Any]]) -> None:
    """Write a capture.

    Parameters
    ----------
    path : str or Path
        It is replaced only once all images are written.
    light, view : (N, 3) float array
        Unit vectors towards the light and the viewer, z > 0.
    images : iterable of (H, W, 3) float array
        N images, row 0 at the top, linear RGB; stored as float32.

    Raises
    ------
    InputError
        Numbers are not finite, a direction is below the horizon, or images differ in number or shape.
    """
    path = Path(path)
    for name, omega in ((LIGHT, light), (VIEW, view)):
        if omega.shape != (len(light), 3) or not np.isfinite(omega).all() or (omega[:, 2] <= HORIZON).any():
            raise InputError(f"'{name}' is not unit vectors (N, 3) above the horizon", where=path)

    def write(temporary: Path) -> None:
        import h5py

        with h5py.File(temporary, "w") as file:
            file[LIGHT] = light[:, :2].astype(np.float32)
            file[VIEW] = view[:, :2].astype(np.float32)
            color, number = None, -1
            for number, image in enumerate(images):
                if image.ndim != 3 or image.shape[2] != 3 or not np.isfinite(image).all():
                    raise InputError(f"image {number} is not finite numbers (H, W, 3)", where=path)
                if color is None:
                    check_texels(image.shape[0], image.shape[1], path)
                    color = file.create_dataset(COLOR, (len(light), *image.shape), np.float32)
                if number >= len(light) or image.shape != color.shape[1:]:
                    raise InputError(f"image {number} differs in shape, or is one too many", where=path)
                color[number] = image.astype(np.float32)
            if number + 1 != len(light) or color is None:
                raise InputError(f"has {number + 1} images of {len(light)} pairs", where=path)

    write_through(path, write)
