"""Perspective pictures of the infinitely repeated tile: pixels as queries, and as truly filtered pixels.

A pixel's filter is a Gaussian with a standard deviation of half a pixel. ``query`` kind: M at the pixel's
position, view direction and isotropic footprint σ, the geometric mean of the two radii of the projected
filter. ``pixel`` kind: the filtered image itself, every path with its own position and view direction. They
agree near normal incidence.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mbtf_core.directions import from_angles
from mbtf_core.errors import UsageError
from mbtf_gen.sampling.query_sampler import Queries

PixelKind = Literal["query", "pixel"]

# Standard deviation of the pixel filter, in pixels.
PIXEL_SIGMA = 0.5
# Pixels that see the plane under a smaller cosine than this are refused: their footprints have no end.
SMALLEST_COSINE = 0.01


def pixel_sigma(area: Any) -> Any:
    """σ of a pixel that sees the given area: the geometric mean of the two radii of its projected Gaussian.

    Works on numbers and on arrays of NumPy and Dr.Jit; areas in squared tile widths give tile widths.
    """
    return PIXEL_SIGMA * area**0.5


@dataclass(frozen=True)
class Camera:
    """A pinhole camera that looks at a point of the reference plane; the image's up is towards +v.

    Attributes
    ----------
    elevation, azimuth : of the direction from the target to the camera, in degrees
    tiles_across : width of the field of view at the target, in tile widths
    target : (x, y) looked at, in tile widths
    rows, columns : of the image
    field_of_view : horizontal, in degrees
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
        # Seen from straight above the image's up is +v; otherwise it is what is up in the world.
        vertical = np.array([0.0, 1.0, 0.0]) if self.elevation > 89.9 else np.array([0.0, 0.0, 1.0])
        right = np.cross(forward, vertical)
        right /= np.linalg.norm(right)
        return forward, right, np.cross(right, forward)

    @property
    def pixel_pitch(self) -> float:
        """Distance between pixel centers on the image plane at distance 1."""
        return 2.0 * float(np.tan(np.radians(self.field_of_view) / 2.0)) / self.columns

    def queries(self, omega_i: NDArray[np.float64], aspect: float = 1.0) -> Queries:
        """One query per pixel, leading axes (rows, columns).

        Parameters
        ----------
        omega_i : (3,) direction towards the light
        aspect : H/W of the tile

        Raises
        ------
        UsageError : pixels look past the plane or along it
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
        # Solid angle of a pixel: pitch² · cos³ of the angle to the image axis; the plane is seen under
        # `cosine`.
        area = distance**2 * self.pixel_pitch**2 / length**3 / cosine
        shape = (self.rows, self.columns)
        return Queries(
            np.mod(point[..., :2] / (1.0, aspect), 1.0).astype(np.float32) % np.float32(1.0),
            pixel_sigma(area).astype(np.float32),
            np.broadcast_to(np.asarray(omega_i, np.float32), (*shape, 3)).copy(),
            (-direction).astype(np.float32),
        )
