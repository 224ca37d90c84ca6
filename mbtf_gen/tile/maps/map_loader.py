"""Reads the maps of a material and validates their aspects and values."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.color import srgb_to_linear
from mbtf_core.errors import InputError
from mbtf_core.images.read import ColorSpace, Image, count_and_first, gray, read_image
from mbtf_core.paths import named_file
from mbtf_gen.tile.maps.checks import refuse_color
from mbtf_gen.tile.maps.file_names import role_of
from mbtf_gen.tile.maps.material_file import ColorEntry, HeightEntry, NormalEntry, ShareEntry
from mbtf_gen.tile.maps.normal_encoding import height_of, stored_xy

Color = NDArray[np.floating[Any]]
Share = NDArray[np.float64] | float | None

_ROUNDING = 1e-6
# Float normals this far below 0 are signed, not (n+1)/2.
_SIGNED = -0.05
# Largest component of a normal in any encoding, with rounding.
_LONGEST = 1.5
_NORMALS = "its pixels are (n+1)/2, or the components of n themselves in a float image"
# Formats whose two channels are gray and alpha.
_GRAY_AND_ALPHA = (".png", ".tga")
# Fraction of normals pointing into the surface above which a warning is given.
_STRAY = 1e-4
_FileEntry = HeightEntry | ColorEntry | ShareEntry | NormalEntry


@dataclass(frozen=True)
class MapFacts:
    """Content of a map's file.

    Attributes
    ----------
    bits : 8 or 16 for integers, None for floats
    channels : number of selected channels
    names : their names, where the file has others
    low, high : smallest and largest stored number of these channels, without alpha
    colorspace : in which the numbers were read
    inverted : whether 1 - x of them is used
    """

    file: Path
    rows: int
    columns: int
    bits: int | None
    channels: int
    names: tuple[str, ...]
    low: float
    high: float
    colorspace: ColorSpace = "linear"
    inverted: bool = False


class MapLoader:
    """Reads the maps of one material; collects files, messages and settings.

    Attributes
    ----------
    files, facts : dict
        File and content of each role.
    settings : dict
        Options and constants of each role that change the data, for the digest.
    warnings, notes : list of str
        Messages for the user.
    """

    def __init__(self, folder: Path, notes: list[str]) -> None:
        self.folder = folder
        self.files: dict[str, Path] = {}
        self.facts: dict[str, MapFacts] = {}
        self.warnings: list[str] = []
        self.notes = notes
        self.settings: dict[str, Any] = {}

    def image(self, role: str, entry: _FileEntry, space: ColorSpace = "linear") -> Image:
        """Read the file of a role, of one pixel or of the heights' aspect."""
        path = named_file(self.folder, str(entry.file))
        image = read_image(path, entry.channel, lambda label: role_of(label) == role)
        count = image.pixels.shape[2]
        used = image.pixels[..., :-1] if count in (2, 4) else image.pixels
        low, high = float(used.min()), float(used.max())
        self.files[role] = path
        self.facts[role] = MapFacts(path, *image.shape, image.bits, count, image.channels, low, high, space)
        if entry.channel is not None:
            self.settings[f"{role}.channel"] = entry.channel
        elif image.channels:
            self.notes.append(f"{role}: channels {', '.join(image.channels)} of {path.name}")
        if image.tags.orientation != 1:
            self.warnings.append(
                f"{path}: its EXIF orientation ({image.tags.orientation}) is ignored, as for every map; "
                "save it upright if it looks turned"
            )
        if image.shape != (1, 1):
            self._check_aspect(path, *image.shape)
        return image

    def _check_aspect(self, path: Path, rows: int, columns: int) -> None:
        height = self.facts["height"]
        h, w = height.rows, height.columns

        def differ(a: int, b: int) -> bool:
            # Half a pixel of rounding in either size is no difference of aspect.
            return abs(h * b - a * w) > 0.5 * max(w, b)

        if differ(rows, columns):
            raise InputError(
                f"is {columns} x {rows} pixels, the height map {height.file.name} {w} x {h}: "
                "maps of one tile need one aspect",
                where=path,
                hint="" if differ(columns, rows) else "one of the two seems to be turned by 90 degrees",
            )

    def share(self, role: str, entry: ShareEntry | None) -> Share:
        """(h, w) numbers in [0, 1], one number, or None."""
        if entry is None:
            return None
        if entry.file is None:
            self.settings[role] = entry.value
            return entry.value
        image = self.image(role, entry, entry.colorspace)
        if role == "opacity":
            refuse_color(image, "opacity")
            spread = np.ptp(image.pixels, axis=(0, 1))
            if len(spread) in (2, 4) and spread[-1] > 0 and not spread[:-1].any():
                image = self.image(role, entry.model_copy(update={"channel": "A"}), entry.colorspace)
        numbers, warnings = gray(image)
        self.warnings += warnings
        numbers = self._within(role, numbers, (numbers < -_ROUNDING) | (numbers > 1 + _ROUNDING))
        if entry.colorspace == "srgb":
            numbers = np.asarray(srgb_to_linear(numbers), np.float64)
        if entry.invert:
            numbers = 1.0 - numbers
            self.facts[role] = replace(self.facts[role], inverted=True)
        if entry.colorspace == "srgb" or entry.invert:
            self.settings[f"{role}.encoding"] = [entry.colorspace, entry.invert]
        return float(numbers[0, 0]) if numbers.shape == (1, 1) else numbers

    def color(self, role: str, entry: ColorEntry, holes: ShareEntry | None = None) -> Color:
        """(h, w, 3) or (3,) linear color; `holes` may be in the alpha channel of its file."""
        if entry.file is None:
            value = np.asarray(entry.value, np.float64)
            value = np.asarray(srgb_to_linear(value) if entry.colorspace == "srgb" else value)
            self.settings[role] = value.tolist()
            return value
        image = self.image(role, entry)
        pixels = image.pixels
        alpha = pixels.shape[2] in (2, 4) and (holes is None or holes.file != entry.file)
        if alpha and np.any(pixels[..., -1] != 1.0):
            self.warnings.append(
                f"{image.path}: the alpha channel of the {role.replace('_', ' ')} is not used; for holes, "
                f"write opacity: {{file: {image.path.name}, channel: A}}"
            )
        rgb = pixels[..., :3] if pixels.shape[2] > 2 else np.repeat(pixels[..., :1], 3, axis=2)
        rgb = self._within(role, rgb, np.any((rgb < -_ROUNDING) | (rgb > 1 + _ROUNDING), axis=-1))
        space = self._color_space(role, image, entry)
        self.facts[role] = replace(self.facts[role], colorspace=space)
        self.settings[role] = space
        linear = (srgb_to_linear(rgb) if space == "srgb" else rgb).astype(np.float32)
        return linear[0, 0] if image.shape == (1, 1) else linear

    def _color_space(self, role: str, image: Image, entry: ColorEntry) -> ColorSpace:
        """The given color space, else linear if the file declares it, else sRGB for integers."""
        space: ColorSpace = "linear" if image.bits is None else "srgb"
        why = "the default for " + ("floats" if image.bits is None else "integers")
        if entry.colorspace is not None:
            space, why = entry.colorspace, "as configured"
        elif image.tags.space == "linear":
            space, why = "linear", "according to its gAMA chunk"
        elif image.tags.foreign is not None:
            self.warnings.append(
                f"{image.path}: its {image.tags.foreign} is not applied, it is read as "
                f"{'sRGB' if space == 'srgb' else 'linear'}; convert it to sRGB"
            )
        shown = "sRGB" if space == "srgb" else "linear"
        self.notes.append(f"{role.replace('_', ' ')}: {image.path.name} read as {shown} ({why})")
        return space

    def normals(self, entry: NormalEntry) -> NDArray[np.float32]:
        """(h, w, 3) unit vectors read as OpenGL, y along v: 2·pixel - 1, or signed floats as they are; z of
        maps that store only x and y is √(1 - x² - y²)."""
        image = self.image("normal", entry)
        stored = image.pixels.astype(np.float32)
        gray_and_alpha = stored.shape[2] == 2 and image.path.suffix.lower() in _GRAY_AND_ALPHA
        if stored.shape[2] == 1 or (gray_and_alpha and np.ptp(stored[..., 1]) == 0):
            raise InputError("is gray; a normal map has two channels or more", where=image.path)
        if gray_and_alpha:
            # x is in alpha.
            stored = stored[..., ::-1]
        signed = image.bits is None and float(stored[..., :2].min()) < _SIGNED
        vectors = stored if signed else 2.0 * stored - 1.0
        two = stored_xy(vectors)
        if two is not None:
            xy = vectors[..., two[0]]
            vectors = np.concatenate([xy, height_of(xy)[..., None]], axis=-1)
            self.warnings.append(f"{image.path}: stores {two[1]} only; z = √(1 - x² - y²) is used")
        elif vectors.shape[2] == 4 and np.any(image.pixels[..., 3] != 1.0):
            self.warnings.append(f"{image.path}: the alpha channel of the normal map is not used")
        vectors = vectors[..., :3]
        long = np.any(np.abs(vectors) > _LONGEST, axis=-1)
        if long.any():
            raise InputError(f"{count_and_first(long)} no normal", where=image.path, hint=_NORMALS)
        length = np.linalg.norm(vectors, axis=-1, keepdims=True)
        below = float(np.mean(vectors[..., 2] <= 0))
        if below > _STRAY:
            self.warnings.append(f"{image.path}: {below:.2%} of its normals point into the surface")
        up = np.array([0.0, 0.0, 1.0], np.float32)
        return np.where(length > 1e-6, vectors / np.maximum(length, 1e-6), up).astype(np.float32)

    def _within(self, role: str, numbers: Any, bad: Any) -> Any:
        if bad.any():
            raise InputError(f"{count_and_first(bad)} outside [0, 1]", where=self.files[role])
        return np.clip(numbers, 0.0, 1.0)
