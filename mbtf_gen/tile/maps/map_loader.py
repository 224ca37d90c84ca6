"""Reads the maps of a material and validates their aspects and values."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.color import srgb_to_linear
from mbtf_core.errors import InputError
from mbtf_core.images.color_spaces import ColorSpace
from mbtf_core.images.limits import MAX_PIXELS
from mbtf_core.images.read import Image, count_and_first, gray, linear_rgb, read_image
from mbtf_core.paths import named_file
from mbtf_gen.tile.maps.checks import refuse_color
from mbtf_gen.tile.maps.file_names import role_of, tokens
from mbtf_gen.tile.maps.material_file import ColorEntry, HeightEntry, NormalEntry, ShareEntry
from mbtf_gen.tile.maps.normal_map import height_of, stored_xy

Color = NDArray[np.floating[Any]]
Share = NDArray[np.float64] | float | None

# Rounding of numbers about 1, and of half floats.
_ROUNDING, _HALF = 1e-6, 2.0**-10
# Rounding of matrices and profiles, beyond which colors out of Rec.709 are reported.
_GAMUT = 1e-3
# Words of file names that say another color space, which files often do not declare.
_FOREIGN_NAMES = {"aces", "acescg"}
_RANGE = "its numbers belong into [0, 1]: scale them, or clamp them in an image editor"
# Numbers that terrains customarily have where there is no data.
_NO_DATA = (-9999.0, -99999.0, -32768.0, -32767.0, -(2.0**31), 2.0**32 - 1.0)
FILL = "fill them first, such as by gdal_fillnodata"
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
    colorspace : ``srgb``, ``linear``, or the name of the color space that was converted
    pixel_size : distance of neighboring columns that the file declares, in meters or its own unit
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
    colorspace: str = "linear"
    pixel_size: float | None = None
    inverted: bool = False


class MapLoader:
    """Reads the maps of one material; collects files, messages and settings.

    Parameters
    ----------
    folder : that file names are relative to
    notes : messages so far
    max_pixels : larger maps are refused

    Attributes
    ----------
    files, facts : file and content of each role
    settings : options and constants of each role that change the data, for the digest
    warnings, notes : messages for the user
    """

    def __init__(self, folder: Path, notes: list[str], max_pixels: int = MAX_PIXELS) -> None:
        self.folder = folder
        self.max_pixels = max_pixels
        self.files: dict[str, Path] = {}
        self.facts: dict[str, MapFacts] = {}
        self.warnings: list[str] = []
        self.notes = notes
        self.settings: dict[str, Any] = {}

    def image(self, role: str, entry: _FileEntry, space: ColorSpace = "linear") -> Image:
        """Read the file of a role, of one pixel or of the heights' aspect."""
        path = named_file(self.folder, str(entry.file))
        image = read_image(path, entry.channel, lambda label: role_of(label) == role, self.max_pixels)
        self._check_data(role, image)
        count = image.stored.shape[2]
        used = image.stored[..., :-1] if count in (2, 4) else image.stored
        low, high = (float(extreme) / image.white for extreme in (used.min(), used.max()))
        size = image.tags.pixel_size
        self.files[role] = path
        self.facts[role] = MapFacts(
            path, *image.shape, image.bits, count, image.channels, low, high, space, size
        )
        if entry.channel is not None:
            self.settings[f"{role}.channel"] = entry.channel
        elif image.channels:
            self.notes.append(f"{role}: channels {', '.join(image.channels)} of {path.name}")
        self.warnings += [f"{path}: {text}" for text in image.tags.unused]
        if image.tags.orientation != 1:
            self.warnings.append(
                f"{path}: its EXIF orientation ({image.tags.orientation}) is ignored, as for every map; "
                "save it upright if it looks turned"
            )
        if image.shape != (1, 1):
            self._check_aspect(path, *image.shape)
        return image

    def _check_data(self, role: str, image: Image) -> None:
        """Refuse heights without data, by what the file declares or by customary numbers; of others, warn."""
        nodata = image.tags.nodata
        if nodata is None and role != "height":
            return
        if nodata is None:
            first = image.stored[..., 0]
            low, high = float(first.min()), float(first.max())
            nodata = next((n for n in _NO_DATA if n in (low, high) and image.bits is None), None)
            if nodata is None:
                return
            rest = first[first != nodata]
            # Heights may be that low, unlike what lies far from all others.
            if rest.size and np.abs(rest - nodata).min() <= np.ptp(rest):
                return
        missing = np.all(image.stored == nodata, axis=-1)
        if not missing.any():
            return
        what = f"{count_and_first(missing)} without data ({nodata:g})"
        if role == "height":
            raise InputError(what, where=image.path, hint=FILL)
        self.warnings.append(f"{image.path}: {what}; they are used as they are")

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
            spread = np.ptp(image.stored, axis=(0, 1))
            if len(spread) in (2, 4) and spread[-1] > 0 and not spread[:-1].any():
                image = self.image(role, entry.model_copy(update={"channel": "A"}), entry.colorspace)
        numbers, warnings = gray(image)
        self.warnings += warnings
        numbers = self._within(image, numbers)
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
        stored = image.stored
        alpha = stored.shape[2] in (2, 4) and (holes is None or holes.file != entry.file)
        if alpha and np.any(stored[..., -1] != image.white):
            self.warnings.append(
                f"{image.path}: the alpha channel of the {role.replace('_', ' ')} is not used; for holes, "
                f"write opacity: {{file: {image.path.name}, channel: A}}"
            )
        if image.bits is None:
            count = 3 if stored.shape[2] > 2 else 1
            image = replace(image, stored=self._within(image, stored[..., :count]))
        space = self._color_space(role, image, entry)
        self.facts[role] = replace(self.facts[role], colorspace=space)
        self.settings[role] = space
        linear = linear_rgb(image, entry.colorspace)
        outside = np.any((linear < -_GAMUT) | (linear > 1.0 + _GAMUT), axis=-1)
        if outside.any():
            self.warnings.append(
                f"{image.path}: colors of {space} beyond Rec.709 are clamped: "
                f"{count_and_first(outside)} outside [0, 1], by at most {_excess(linear):.2g}"
            )
        np.clip(linear, 0.0, 1.0, out=linear)
        return linear[0, 0] if image.shape == (1, 1) else linear

    def _color_space(self, role: str, image: Image, entry: ColorEntry) -> str:
        """Name of the color space: given, else declared by the file, else by the kind of numbers."""
        tags = image.tags
        space, why = ("linear", "floats") if image.bits is None else ("srgb", "integers")
        why = f"the default for {why}"
        if entry.colorspace is not None:
            space, why = entry.colorspace, "as configured"
            if tags.declared is not None:
                self.warnings.append(
                    f"{image.path}: its {tags.declared.name} is not applied, as colorspace is given"
                )
        elif tags.declared is not None:
            space, why = tags.declared.name, "as it declares, converted to linear Rec.709"
        elif tags.space is not None:
            space, why = tags.space, "as it declares" if tags.space != space else why
        shown = "sRGB" if space == "srgb" else space
        if entry.colorspace is None and tags.foreign is not None:
            what = f"is not applied, it is read as {shown}; convert it to sRGB"
            if tags.space is not None:
                what = f"has the numbers of {shown} in spite of its name, and is read as that"
            self.warnings.append(f"{image.path}: its {tags.foreign} {what}")
        named = _FOREIGN_NAMES.intersection(tokens(image.path.name))
        if named and entry.colorspace is None and (tags.space, tags.declared, tags.foreign) == (None,) * 3:
            self.warnings.append(
                f"{image.path}: its name says {min(named)}, but it declares no color space, and is read as "
                f"{shown}; if it is not, convert it"
            )
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

    def _within(self, image: Image, numbers: Any) -> Any:
        """Numbers (H, W) or (H, W, C) in [0, 1], clamped as far as compression and rounding may exceed it."""
        if image.bits is not None:
            return numbers
        excess = _excess(numbers)
        if excess <= 0:
            return numbers
        allowed = max(image.excess, _HALF if image.stored.dtype == np.float16 else _ROUNDING)
        slack = 0.0 if image.compression else _ROUNDING
        if excess > slack:
            outside = (numbers < -slack) | (numbers > 1 + slack)
            bad = outside if outside.ndim == 2 else outside.any(axis=-1)
            what = f"{count_and_first(bad)} outside [0, 1]"
            if excess > allowed:
                more = f" by up to {excess:.3g}" if allowed > _ROUNDING else ""
                raise InputError(f"{what}{more}", where=image.path, hint=_RANGE)
            cause = f"{image.compression} compression" if image.compression else "the rounding of half floats"
            self.warnings.append(f"{image.path}: {what}, by at most {excess:.2g}, within {cause}: clamped")
        return np.clip(numbers, 0.0, 1.0)


def _excess(numbers: Any) -> float:
    """By how much numbers leave [0, 1], at most."""
    return max(-float(numbers.min()), float(numbers.max()) - 1.0)
