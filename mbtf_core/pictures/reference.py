"""Stored reference pictures, with both halves.

A picture is stored as an EXR image with the channels of the shard schema (``u.x``, ``omega_o.z``,
``value_a.R``, …), so that a fitted material can be evaluated at its queries, and as a PNG for display.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.schema import Queries
from mbtf_core.data.shard_files import read_exr, write_exr
from mbtf_core.errors import InputError
from mbtf_core.exposure import to_display
from mbtf_core.files.atomic import write_file
from mbtf_core.files.folders import OutputFolder, OutputKind
from mbtf_core.pictures.camera import Camera, PixelKind
from mbtf_core.suggest import suggest_path

# What does not change the content of pictures: the name of the material, and how values are displayed.
_DISPLAY = ("material", "exposure")
# Of an 8-bit pixel, at most.
PNG_BYTES = 3


@dataclass(frozen=True)
class ReferenceImage:
    """A rendered picture.

    Attributes
    ----------
    kind : {"query", "pixel"}
        Meaning of a pixel, see :mod:`mbtf_core.pictures.camera`.
    camera : the camera
    queries : one per pixel, with leading axes (rows, columns)
    value_a, value_b : (rows, columns, 3) float32 array
        Independent halves, in 1/sr.
    spp : paths per pixel, both halves together
    transmittance : (rows, columns) float32 array or None
        Fraction of the view rays that the opacity mask transmits; None without a mask.
    """

    kind: PixelKind
    camera: Camera
    queries: Queries
    value_a: NDArray[np.float32]
    value_b: NDArray[np.float32]
    spp: int
    transmittance: NDArray[np.float32] | None = None

    @property
    def value(self) -> NDArray[np.float32]:
        """Mean of the halves, (rows, columns, 3)."""
        return 0.5 * (self.value_a + self.value_b)

    def write(self, path: Path) -> Path:
        """Write ``path`` + ``.exr`` with all channels, atomically, and return its path."""
        spp = np.full(self.queries.lead, self.spp, np.float32)
        arrays = {**vars(self.queries), "value_a": self.value_a, "value_b": self.value_b, "spp": spp}
        if self.transmittance is not None:
            arrays["transmittance"] = self.transmittance
        exr = path.with_name(f"{path.name}.exr")
        write_exr(exr, {name: array[None] for name, array in arrays.items()})
        return exr


def pictures_of(command: str) -> OutputKind:
    """Pictures that a command writes, such as ``mbtf-gen reference``."""
    return OutputKind("pictures.json", command.replace(" ", "-"), 3, f"pictures of {command}")


def claim_pictures(
    path: Path,
    command: str,
    *,
    files: Iterable[str],
    config: Mapping[str, Any],
    inputs: Mapping[str, str],
    overwrite: bool = False,
) -> OutputFolder:
    """Claim a folder for the pictures of a command; the caller owns it.

    Parameters
    ----------
    command : such as ``mbtf-gen reference``
    files : names of all files that may be written
    config : resolved options, written beside the pictures; ``material`` and ``exposure`` do not determine
        their content, the others do
    inputs : digests of the input files by role, which determine it as well
    overwrite : remove what the folder's record lists, and start anew

    Raises
    ------
    InputError : the folder holds something else
    """
    depends = {key: value for key, value in config.items() if key not in _DISPLAY}
    return OutputFolder.claim(
        path,
        pictures_of(command),
        {**depends, "inputs": dict(inputs)},
        files,
        config=config,
        overwrite=overwrite,
    )


def read_references(folder: Path) -> list[tuple[NDArray[np.float32], Camera, NDArray[np.float32]]]:
    """Value in 1/sr, camera, and direction of the light of the finished pictures of ``mbtf-gen reference``.

    Parameters
    ----------
    folder : output folder of the command

    Returns
    -------
    list of (array (rows, columns, 3), Camera, array (3,))

    Raises
    ------
    InputError : the folder has no such pictures
    """
    known = pictures_of("mbtf-gen reference").read(folder)
    if known is None:
        hint = suggest_path(folder, Path.is_dir)
        raise InputError("holds no pictures of mbtf-gen reference", where=folder, hint=hint)
    options = known["depends"]["reference"]
    out = []
    for across in options["tiles_across"]:
        name = next((n for n in known["items"] if n.endswith(f"-tiles{across:g}")), None)
        if name is None:
            continue
        path = folder / f"{name}.exr"
        value, light = read_value(path), read_exr(path, ("omega_i",))["omega_i"].reshape(-1, 3)[0]
        rows, columns = value.shape[:2]
        view = options["view"]
        out.append(
            (value, Camera(view["elevation"], view["azimuth"], across, rows=rows, columns=columns), light)
        )
    if not out:
        raise InputError("holds no finished picture", where=folder, hint="run mbtf-gen reference again")
    return out


def read_value(path: Path) -> NDArray[np.float32]:
    """Value (rows, columns, 3) of a picture that :meth:`ReferenceImage.write` wrote."""
    stored = read_exr(path, ("value_a", "value_b"))
    value: NDArray[np.float32] = 0.5 * (stored["value_a"] + stored["value_b"])
    return value.reshape(value.shape[-3:])


def write_display(path: Path, value: NDArray[np.float32], exposure: float) -> Path:
    """Write ``path`` + ``.png``, sRGB of a linear picture at an exposure in EV, and return its path."""
    png = path.with_name(f"{path.name}.png")
    write_png(png, to_display(value, exposure))
    return png


def write_png(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Write an 8-bit picture (rows, columns, 3), atomically."""
    from PIL import Image

    write_file(path, lambda stream: Image.fromarray(pixels).save(stream, format="PNG"))
