"""Reads the maps that a material names and checks that they fit together and hold what they should."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .atomic import digest
from .errors import InputError
from .images import Image, count_and_first, grey, read_image, srgb_to_linear
from .material_file import ColourEntry, ShareEntry

Colour = NDArray[np.floating[Any]]
Share = NDArray[np.float64] | float | None

# Linear grey where no base colour is given.
DEFAULT_COLOUR = 0.5
_ROUNDING = 1e-6


class MapLoader:
    """Reads the maps of one material; collects files, remarks, and what else changes the data.

    Attributes
    ----------
    files : role → file, of everything read
    settings : role → options and constants that change the data, for the digest
    warnings, notes : remarks for the user
    """

    def __init__(self, folder: Path, notes: list[str]) -> None:
        self.folder = folder
        self.files: dict[str, Path] = {}
        self.shapes: dict[str, tuple[int, int]] = {}
        self.warnings: list[str] = []
        self.notes = notes
        self.settings: dict[str, Any] = {}

    def image(self, role: str, name: str) -> Image:
        """Read the file of a role; its aspect must be that of the heights, unless it is a single pixel."""
        path = self.folder / name
        image = read_image(path)
        self.files[role] = path
        self.shapes[role] = image.shape
        if role != "height" and image.shape != (1, 1):
            (h, w), (rows, columns) = self.shapes["height"], image.shape
            # Half a pixel of rounding in either size is no difference of aspect.
            if abs(h * columns - rows * w) > 0.5 * max(w, columns):
                raise InputError(
                    f"is {columns} x {rows} pixels, the height map {self.files['height'].name} {w} x {h}: "
                    "maps of one tile need one aspect",
                    where=path,
                )
        return image

    def share(self, role: str, entry: ShareEntry | None) -> Share:
        """(h, w) numbers in [0, 1], one number, or None."""
        if entry is None:
            return None
        if entry.file is None:
            self.settings[role] = entry.value
            return entry.value
        numbers, warnings = grey(self.image(role, entry.file))
        self.warnings += warnings
        numbers = self._within(role, numbers, (numbers < -_ROUNDING) | (numbers > 1 + _ROUNDING))
        return float(numbers[0, 0]) if numbers.shape == (1, 1) else numbers

    def colour(self, entry: ColourEntry | None) -> Colour:
        """(h, w, 3) or (3,) linear colour."""
        if entry is None:
            self.notes.append(f"base colour: {DEFAULT_COLOUR} grey, none is given")
            return np.full(3, DEFAULT_COLOUR)
        if entry.file is None:
            value = np.asarray(entry.value, np.float64)
            value = np.asarray(srgb_to_linear(value) if entry.colourspace == "srgb" else value)
            self.settings["basecolor"] = value.tolist()
            return value
        image = self.image("basecolor", entry.file)
        pixels = image.pixels
        if pixels.shape[2] in (2, 4) and np.any(pixels[..., -1] != 1.0):
            self.warnings.append(f"{image.path}: the alpha channel of the base colour is not used")
        rgb = pixels[..., :3] if pixels.shape[2] > 2 else np.repeat(pixels[..., :1], 3, axis=2)
        rgb = self._within("basecolor", rgb, np.any((rgb < -_ROUNDING) | (rgb > 1 + _ROUNDING), axis=-1))
        space = entry.colourspace or ("linear" if image.bits is None else "srgb")
        self.notes.append(f"base colour: {image.path.name} read as {'sRGB' if space == 'srgb' else 'linear'}")
        self.settings["basecolor"] = space
        linear = (srgb_to_linear(rgb) if space == "srgb" else rgb).astype(np.float32)
        return linear[0, 0] if image.shape == (1, 1) else linear

    def normals(self, name: str, convention: str) -> NDArray[np.float32]:
        """(h, w, 3) unit vectors n with y along v, from pixels (n+1)/2."""
        image = self.image("normal", name)
        if image.pixels.shape[2] < 3:
            raise InputError("is grey; a normal map has three channels", where=image.path)
        vectors = 2.0 * image.pixels[..., :3].astype(np.float32) - 1.0
        if convention == "dx":
            vectors[..., 1] *= -1.0
        length = np.linalg.norm(vectors, axis=-1, keepdims=True)
        below = int((vectors[..., 2] <= 0).sum())
        if below:
            self.warnings.append(f"{image.path}: {below} normals point into the surface")
        up = np.array([0.0, 0.0, 1.0], np.float32)
        self.settings["normal"] = convention
        return np.where(length > 1e-6, vectors / np.maximum(length, 1e-6), up).astype(np.float32)

    def _within(self, role: str, numbers: Any, bad: Any) -> Any:
        if bad.any():
            raise InputError(f"{count_and_first(bad)} outside [0, 1]", where=self.files[role])
        return np.clip(numbers, 0.0, 1.0)

    def digests(self) -> dict[str, str]:
        """role → SHA-256 of the file."""
        return {role: digest(path) for role, path in self.files.items()}
