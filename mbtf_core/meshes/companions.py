"""Files that a mesh refers to: where they lie, and the numbers of its images."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_core.images.read import Image, count_and_first, gray, linear_rgb, read_image

# Part of 1 by which numbers of an image may leave [0, 1].
_ROUNDING = 1e-6
# The same of converted colors, beyond which it is said.
_GAMUT = 1e-3


class Companions:
    """Finds and reads files that a mesh names, relative to its folder.

    Collects them, by the name that the mesh gives them, and warnings.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.files: dict[str, Path] = {}
        self.warnings: list[str] = []

    def find(self, name: str) -> Path:
        """A file by the name that the mesh or its materials give it; an InputError where there is none, or
        several whose names differ in case alone.

        Names may have another case than the file and the separators of Windows. Where no file is at the whole
        path, one at its end counts, with a warning: paths often come from another machine.
        """
        if name in self.files:
            return self.files[name]
        folder = self.path.parent
        parts = [part for part in re.split(r"[\\/]+", name) if part not in ("", ".")]
        places = [folder / name, *(folder.joinpath(*parts[skipped:]) for skipped in range(len(parts)))]
        for number, place in enumerate(places):
            found = _in_any_case(place, folder)
            if found is not None:
                # The first two places are those of the whole name.
                if number > 1:
                    self.warnings.append(
                        f"'{name}' is not there; {found.relative_to(folder)} is read instead"
                    )
                self.files[name] = found
                return found
        raise InputError(
            f"the file '{name[:200]}' that it names is missing", where=self.path, hint=f"put it into {folder}"
        )

    def color(self, name: str) -> NDArray[np.float32]:
        """Linear Rec.709 colors (h, w, 3) of an image, from the color space that it declares; without one,
        integers are sRGB. Colors beyond Rec.709 are clamped, with a warning. An InputError where the image is
        missing, unreadable, or not within [0, 1]."""
        image = self._image(name)
        stored = image.stored
        if stored.shape[2] in (2, 4) and np.any(stored[..., -1] != image.white):
            self.warnings.append(f"{image.path.name}: its alpha channel is not used")
        if image.bits is None:
            _check_range(stored[..., : 3 if stored.shape[2] > 2 else 1], image.path)
        if image.tags.foreign is not None:
            shown = "sRGB" if image.space == "srgb" else image.space
            self.warnings.append(
                f"{image.path.name}: its {image.tags.foreign} is not applied, it is read as {shown}"
            )
        rgb = linear_rgb(image)
        if rgb.min() < -_GAMUT or rgb.max() > 1.0 + _GAMUT:
            self.warnings.append(f"{image.path.name}: its colors beyond Rec.709 are clamped")
        return np.clip(rgb, 0.0, 1.0, out=rgb)

    def share(self, name: str, channel: str | None = None, *, alpha: bool = False) -> NDArray[np.float32]:
        """Numbers (h, w) of an image: a channel, its alpha where it is asked for and not all 1, or its
        luminance; errors as of :meth:`color`."""
        image = self._image(name, channel)
        if alpha and image.stored.shape[2] in (2, 4) and np.any(image.stored[..., -1] != image.white):
            image = self._image(name, "A")
        numbers, warnings = gray(image)
        self.warnings += warnings
        _check_range(numbers[..., None], image.path)
        return numbers.astype(np.float32)

    def _image(self, name: str, channel: str | None = None) -> Image:
        image = read_image(self.find(name), channel)
        if image.tags.orientation != 1:
            self.warnings.append(f"{image.path.name}: its EXIF orientation is ignored; save it upright")
        return image


def _check_range(pixels: NDArray[np.floating], path: Path) -> None:
    bad = np.any((pixels < -_ROUNDING) | (pixels > 1.0 + _ROUNDING), axis=-1)
    if bad.any():
        raise InputError(f"{count_and_first(bad)} outside [0, 1]", where=path)


def _in_any_case(path: Path, folder: Path) -> Path | None:
    """A file as it is named, or the only one whose path below a folder differs in case alone."""
    try:
        if path.is_file():
            return path
        found = folder
        for part in path.relative_to(folder).parts:
            alike = [p for p in found.iterdir() if p.name.lower() == part.lower()]
            if (found / part).exists():
                found /= part
            elif len(alike) == 1:
                found = alike[0]
            else:
                return None
        return found if found.is_file() else None
    except (OSError, ValueError):
        # Not a folder, not readable, or no name that the system accepts.
        return None
