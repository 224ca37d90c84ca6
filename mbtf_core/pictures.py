"""Perspective pictures of the infinitely repeated tile: pixels as queries, exactly filtered pixels, storage.

The pixel filter is a Gaussian with a standard deviation of half a pixel. A picture of kind ``query``
evaluates M at each pixel's position, view direction and isotropic footprint σ, which is the geometric mean of
the two radii of the projected filter. Kind ``pixel`` is the filtered image itself: every path has its own
position and view direction. The two agree near normal incidence.

A picture is stored as an EXR image with the channels of the shard schema (``u.x``, ``omega_o.z``,
``value_a.R``, …) and with both halves, so that a fitted material can be evaluated at its queries, and as a
PNG for display.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.color import to_display
from mbtf_core.data.schema import Queries
from mbtf_core.data.shard_files import read_exr, write_exr
from mbtf_core.directions import from_angles
from mbtf_core.errors import InputError, UsageError
from mbtf_core.files.atomic import write_file
from mbtf_core.files.folders import OutputFolder, OutputKind
from mbtf_core.paths import suggest_path

PixelKind = Literal["query", "pixel"]

# Standard deviation of the pixel filter, in pixels.
PIXEL_SIGMA = 0.5
# Smallest cosine between the plane's normal and a pixel's ray; at the horizon footprints are unbounded.
SMALLEST_COSINE = 0.01
# Fraction of a picture, along its tighter side, that tiles fill, and its height over its width.
_FILL, _PROPORTION = 0.94, 0.75
# What does not change the content of pictures: names of inputs, and how values are displayed.
_DISPLAY = ("material", "shards", "exposure")
# Of an 8-bit pixel, at most.
PNG_BYTES = 3


def pixel_sigma(area: Any) -> Any:
    """Footprint σ of a pixel in tile widths: the geometric mean of the two radii of its projected Gaussian,
    by the area of the pixel on the surface in squared tile widths (float, array or Float)."""
    return PIXEL_SIGMA * area**0.5


@dataclass(frozen=True)
class Camera:
    """A pinhole camera that looks at a point of the reference plane; the image's up is towards +v.

    Parameters
    ----------
    elevation, azimuth : direction from the target to the camera, in degrees
    tiles_across : width of the field of view at the target, in tile widths
    target : (float, float)
        Point of the reference plane at the image's center, in tile widths.
    rows, columns : size of the image in pixels
    field_of_view : horizontal angle, in degrees
    """

    elevation: float = 60.0
    azimuth: float = -90.0
    tiles_across: float = 2.0
    target: tuple[float, float] = (0.5, 0.5)
    rows: int = 256
    columns: int = 256
    field_of_view: float = 20.0

    @property
    def distance(self) -> float:
        """Distance from the target in tile widths."""
        return self.tiles_across / (2.0 * np.tan(np.radians(self.field_of_view) / 2.0))

    @property
    def position(self) -> NDArray[np.float64]:
        """Position (3,) in tile widths."""
        out: NDArray[np.float64] = np.array([*self.target, 0.0]) + self.distance * self._towards
        return out

    @property
    def _towards(self) -> NDArray[np.float64]:
        return from_angles(self.elevation, self.azimuth)

    def frame(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """(forward, right, up) unit vectors; right and up are those of the image."""
        forward = -self._towards
        # Seen from above, the image's up is +v; otherwise it is the projected normal.
        vertical = np.array([0.0, 1.0, 0.0]) if self.elevation > 89.9 else np.array([0.0, 0.0, 1.0])
        right = np.cross(forward, vertical)
        right /= np.linalg.norm(right)
        return forward, right, np.cross(right, forward)

    @property
    def pixel_pitch(self) -> float:
        """Distance between pixel centers on the image plane at distance 1."""
        return 2.0 * float(np.tan(np.radians(self.field_of_view) / 2.0)) / self.columns

    @property
    def pixel_width(self) -> float:
        """Geometric mean of the sides of the pixel at the image's center on the plane, in tile widths."""
        slant = float(np.sin(np.radians(self.elevation)))
        return float(self.distance) * self.pixel_pitch / slant**0.5

    def queries(self, omega_i: ArrayLike, aspect: float = 1.0) -> Queries:
        """One query per pixel, leading axes (rows, columns).

        Parameters
        ----------
        omega_i : (3,) float array
            Unit vector towards the light.
        aspect : H/W of the tile

        Returns
        -------
        Queries
            ``u``, ``sigma``, ``omega_i`` and ``omega_o`` of the pixels.

        Raises
        ------
        UsageError : the image shows the horizon
        """
        forward, right, up = self.frame()
        x = (np.arange(self.columns) + 0.5 - self.columns / 2) * self.pixel_pitch
        y = (self.rows / 2 - np.arange(self.rows) - 0.5) * self.pixel_pitch
        ray = forward + x[None, :, None] * right + y[:, None, None] * up
        length = np.linalg.norm(ray, axis=-1)
        direction = ray / length[..., None]
        cosine = -direction[..., 2]
        if cosine.min() < SMALLEST_COSINE:
            raise UsageError(
                f"the view from elevation {self.elevation:g} degrees shows the horizon",
                hint="raise the elevation or narrow the field of view",
            )
        distance = self.position[2] / cosine
        point = self.position + distance[..., None] * direction
        # A pixel's solid angle is pitch² · cos³ of its angle to the image axis; `cosine` is the plane's.
        area = distance**2 * self.pixel_pitch**2 / length**3 / cosine
        shape = (self.rows, self.columns)
        return Queries(
            np.mod(point[..., :2] / (1.0, aspect), 1.0).astype(np.float32) % np.float32(1.0),
            pixel_sigma(area).astype(np.float32),
            np.broadcast_to(np.asarray(omega_i, np.float32), (*shape, 3)).copy(),
            (-direction).astype(np.float32),
        )


def tiles_camera(
    elevation: float, azimuth: float, *, tiles: int, aspect: float, displacement_range: float, columns: int
) -> Camera:
    """Camera that looks at the center of `tiles` × `tiles` tiles of H/W `aspect` and just fits them; pictures
    are 4:3. Elevation and azimuth are those towards the camera, in degrees; the displacement range is the
    largest depth of the tile, in tile widths."""
    x, y = 0.5 * tiles, 0.5 * tiles * aspect
    rows = max(1, round(_PROPORTION * columns))
    camera = Camera(elevation, azimuth, 1.0, (x, y), rows, columns)
    forward, right, up = camera.frame()
    # Relative to the target. At distance d, a corner c fits if |c·right| ≤ half the width · (d + c·forward).
    corners = np.array(list(product((-x, x), (-y, y), (0.0, -displacement_range))))
    half = 0.5 * _FILL * camera.pixel_pitch
    across, along = np.abs(corners @ right) / (half * columns), np.abs(corners @ up) / (half * rows)
    distance = float((np.maximum(across, along) - corners @ forward).max())
    return replace(camera, tiles_across=distance / camera.distance)


@dataclass(frozen=True)
class ReferenceImage:
    """A rendered picture.

    Attributes
    ----------
    value_a, value_b : (rows, columns, 3) float32 array
        Independent halves, in 1/sr.
    spp : paths per pixel, both halves together
    transmittance : (rows, columns) float32 array or None
        Fraction of the view rays that the opacity mask transmits, or that miss a displaced shape; None where
        there is neither.
    queries : one per pixel, with leading axes (rows, columns); None for a displaced shape
    """

    value_a: NDArray[np.float32]
    value_b: NDArray[np.float32]
    spp: int
    transmittance: NDArray[np.float32] | None = None
    queries: Queries | None = None

    @property
    def value(self) -> NDArray[np.float32]:
        """Mean of the halves, (rows, columns, 3)."""
        return 0.5 * (self.value_a + self.value_b)

    def write(self, path: Path) -> Path:
        """Write ``path`` + ``.exr`` with all channels, atomically, and return its path."""
        spp = np.full(self.value_a.shape[:2], self.spp, np.float32)
        arrays = {"value_a": self.value_a, "value_b": self.value_b, "spp": spp}
        if self.queries is not None:
            arrays |= vars(self.queries)
        if self.transmittance is not None:
            arrays["transmittance"] = self.transmittance
        exr = path.with_name(f"{path.name}.exr")
        found = {name: array[None] for name, array in arrays.items()}
        write_exr(exr, found, complete=self.queries is not None)
        return exr


def pictures_of(command: str) -> OutputKind:
    """Pictures that a command writes, such as ``mbtf-gen reference``."""
    return OutputKind("pictures.json", command.replace(" ", "-"), 4, f"pictures of {command}")


def claim_pictures(
    path: Path,
    command: str,
    *,
    files: Iterable[str],
    config: Mapping[str, Any],
    inputs: Mapping[str, str],
    overwrite: bool = False,
) -> OutputFolder:
    """Claim a folder for the pictures of a command, such as ``mbtf-gen reference``; the caller owns it.

    `files` are names of all files that may be written. Resolved options are written beside the pictures; all
    but ``material`` and ``exposure`` determine their content, and so do the digests of the input files by
    role. An InputError where the folder holds something else. To overwrite is to remove what its record
    lists.
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
    """Value (rows, columns, 3) in 1/sr, camera, and direction (3,) of the light of the finished pictures in
    an output folder of ``mbtf-gen reference``; an InputError where it has none."""
    known = pictures_of("mbtf-gen reference").read(folder)
    if known is None:
        hint = suggest_path(folder, Path.is_dir)
        raise InputError("holds no pictures of mbtf-gen reference", where=folder, hint=hint)
    options = known["depends"]["reference"]
    if options.get("surface", "plane") != "plane":
        raise InputError(f"shows a {options['surface']}, not the plane", where=folder)
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
