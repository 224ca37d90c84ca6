"""Recognition of the maps in a folder by their file names."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path
from typing import Any

from mbtf_core.data.dataset import is_dataset
from mbtf_core.errors import InputError
from mbtf_core.images.read import SUFFIXES, is_image, read_image
from mbtf_core.meshes.read import MESH_FILES
from mbtf_gen.tile.maps.file_names import (
    SMOOTHNESS_IN_ALPHA,
    WEAK_WORDS,
    WORDS,
    MapName,
    Role,
    Source,
    Unused,
    read_name,
    role_of,
    tokens,
)

_ARCHIVES = (".zip", ".7z", ".rar", ".tar", ".tgz", ".gz")
# Suffixes of image formats, and of materials of other programs, that are not read.
_UNREAD = (
    *(".astc", ".avif", ".basis", ".crn", ".dds", ".gif", ".hdr", ".heic", ".iff", ".jfif", ".jp2", ".jxl"),
    *(".jxr", ".ktx", ".ktx2", ".mxr", ".pcx", ".pfm", ".pgm", ".pic", ".ppm", ".psb", ".psd", ".pvr"),
    *(".r16", ".r32", ".raw", ".rgb", ".sbs", ".sbsar", ".sgi", ".svg", ".sxr", ".tex", ".tx", ".vtf"),
    *(".webp", ".xcf"),
)
# Names listed in a message.
_LISTED = 6
# A name that YAML reads as text without quotes.
_PLAIN = re.compile(r"[A-Za-z_][\w./-]*")


@dataclass(frozen=True)
class FoundMap:
    """A file, or a channel of it, that stores a map."""

    path: Path
    name: MapName
    source: Source

    @property
    def entry(self) -> str | dict[str, Any]:
        """The entry of a material file."""
        options: dict[str, Any] = {}
        if self.source.channel is not None:
            options["channel"] = self.source.channel
        if self.source.invert:
            options["invert"] = True
        return {"file": self.path.name, **options} if options else self.path.name


@dataclass(frozen=True)
class FoundMaps:
    """Maps found in a folder.

    Attributes
    ----------
    maps : file of each role
    entries : entry of a material file of each role, which names the channel of a packed map
    unused : reason why an image is not used, by file name
    notes, warnings : messages for the user
    """

    maps: dict[Role, Path] = field(default_factory=dict)
    entries: dict[Role, Any] = field(default_factory=dict)
    unused: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


# How one of several files of a map is chosen, in this order: what is smallest, and why others are left out.
_Choice = tuple[Callable[[FoundMap], int], str]
_CHOICES: tuple[_Choice, ...] = (
    (lambda m: m.name.workflow == "specular", "{} is of the metalness workflow"),
    (lambda m: m.source.rank, "{} is used"),
    (lambda m: m.name.convention != "gl", "{} is the normal map"),
    (lambda m: not m.name.deep, "{}, of 16 bits, is used"),
)


def _variant_choice(candidates: Iterable[list[FoundMap]]) -> _Choice:
    """The choice of the first variant that all maps with variants have; none where there is no such one."""
    numbers = [{m.name.variant for m in given} for given in candidates if any(m.name.variant for m in given)]
    first = min(set.intersection(*numbers), default=None) if numbers else None
    return (lambda m: m.name.variant != first, "{} is the first variant")


def _shared_words(names: list[str]) -> int:
    """Number of leading words that all of several names share: they name the material, not a map."""
    columns = zip(*map(tokens, names), strict=False)
    return sum(1 for _ in takewhile(lambda words: len(set(words)) == 1, columns)) if len(names) > 1 else 0


def find_maps(folder: Path) -> FoundMaps:
    """Find the maps in a folder, without its subfolders.

    Leading words that all names share are ignored, unless only they denote a height map: of ``Metal004.png``
    and ``Metal004_Color.png`` the former is a picture of the material. Of several files of one map, a file of
    its own is preferred to a channel of a packed map, OpenGL normals to DirectX ones, 16 bits to 8, and the
    first variant to others.

    Raises
    ------
    InputError : the folder is unreadable, has no image or no height map, or several candidates for a map
    """
    files = _images(folder)
    unread = _unread(folder, files)
    if not files:
        raise InputError(
            "the folder contains no image that is read",
            where=folder,
            hint=_elsewhere(folder) or unread or f"a height map is required ({', '.join(SUFFIXES)})",
        )
    shared = _shared_words([p.name for p in files])
    if not any(role_of(p.name, shared) == "height" for p in files):
        if not any(role_of(p.name) == "height" for p in files):
            raise _no_heights(folder, files, shared, unread)
        shared = 0
    names = {path: read_name(path.name, shared) for path in files}
    candidates: dict[Role, list[FoundMap]] = {}
    for path, name in names.items():
        for source in _sources(path, name):
            candidates.setdefault(source.role, []).append(FoundMap(path, name, source))
    reasons: dict[Path, str] = {}
    choices = (*_CHOICES, _variant_choice(candidates.values()))
    chosen = {role: _choose(given, choices, reasons) for role, given in candidates.items()}
    maps = {role: given[0].path for role, given in chosen.items()}
    entries = {role: given[0].entry for role, given in chosen.items()}
    several = [
        f"{role} ({_listed(m.path.name for m in given)})" for role, given in chosen.items() if len(given) > 1
    ]
    if several:
        raise InputError(
            f"two maps or more of {' and of '.join(several)}",
            where=folder,
            hint="remove all but one of each, or say which is meant in a material.yaml: "
            + _on_one_line({role: entries[role] for role in WORDS if role in entries}),
        )
    notes = [f"{role}: 1 - {m.path.name}" for role, (m,) in chosen.items() if m.source.invert]
    rest = {path: name for path, name in names.items() if path not in maps.values()}
    unused, lost = _left_out(rest, reasons, maps)
    notes += [f"{path.name} is not used: {why}" for path, why in unused.items() if why not in lost]
    texts = [f"{_listed(given)} ({reason})" for reason, given in lost.items()]
    warnings = [f"{folder}: not used: {'; '.join(texts)}"] if texts else []
    warnings += [f"{folder}: {unread}"] if unread else []
    if "roughness" not in maps:
        glossless = (path for path, name in names.items() if name.word.startswith(SMOOTHNESS_IN_ALPHA))
        what = "has no alpha channel, or one of 1 only, for its gloss: roughness is missing"
        warnings += [f"{path}: {what}" for path in glossless]
    if "opacity" in maps and names[maps["opacity"]].word == "mask":
        warnings.append(
            f"{maps['opacity']}: is used as opacity, 0 for a hole, for its name says no more than 'mask'; "
            "remove it if it is another mask"
        )
    return FoundMaps(maps, entries, {path.name: why for path, why in unused.items()}, notes, warnings)


def _left_out(
    names: Mapping[Path, MapName], reasons: Mapping[Path, str], maps: Container[Role]
) -> tuple[dict[Path, str], dict[str, list[str]]]:
    """Why files are not used, and the names of those that the material may lack by reason."""
    metalness = any("metalness workflow" in reason for reason in reasons.values())
    out: dict[Path, str] = {}
    lost: dict[str, list[str]] = {}
    for path, name in names.items():
        missing = False
        if isinstance(name.content, Unused):
            out[path], missing = name.content.reason, name.content.lost
            missing = missing and not (metalness and name.workflow == "specular")
        elif name.content is None:
            # A picture of the material is named like it, but so may be its color.
            out[path], missing = "its name matches no map", not name.bare or "base_color" not in maps
        else:
            out[path] = reasons.get(path, "its alpha channel is missing")
        if missing:
            lost.setdefault(out[path], []).append(path.name)
    return out, lost


def _sources(path: Path, name: MapName) -> list[Source]:
    """What a file stores; something in an alpha channel only where the file has one."""
    content = name.content if isinstance(name.content, tuple) else ()
    return [source for source in content if source.channel != "A" or _has_alpha(path)]


def _has_alpha(path: Path) -> bool:
    """Whether an image has an alpha channel that is not 1 everywhere, as programs fill one that they do not
    need; or cannot be read, which its use reports."""
    with contextlib.suppress(InputError):
        pixels = read_image(path).pixels
        return pixels.shape[2] in (2, 4) and bool((pixels[..., -1] != 1.0).any())
    return True


def _choose(given: list[FoundMap], choices: Iterable[_Choice], reasons: dict[Path, str]) -> list[FoundMap]:
    """The preferred one of several files of a map; all where their names do not say that they are of one
    map. Adds the reasons why the others are not used."""
    if any(found.name.rest != given[0].name.rest for found in given):
        return given
    for key, reason in choices:
        best = min(map(key, given))
        first = next(found for found in given if key(found) == best)
        reasons |= {m.path: reason.format(first.path.name) for m in given if key(m) != best}
        given = [found for found in given if key(found) == best]
    return given


def _on_one_line(value: Any) -> str:
    """Plain data as YAML."""
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key}: {_on_one_line(inner)}' for key, inner in value.items())}}}"
    return value if isinstance(value, str) and _PLAIN.fullmatch(value) else json.dumps(value)


def unpack(path: Path) -> str:
    """The hint to unpack an archive; empty for other files."""
    return f"unpack {path.name} and give its folder" if path.suffix.lower() in _ARCHIVES else ""


def _content(folder: Path) -> list[Path]:
    try:
        return sorted(p for p in folder.iterdir() if not p.name.startswith("."))
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=folder) from None


def _images(folder: Path) -> list[Path]:
    return [p for p in _content(folder) if not p.is_dir() and is_image(p)]


def _elsewhere(folder: Path) -> str:
    """Hint at what else is there: a data set, a mesh, a subfolder with a height map, or an archive."""
    if is_dataset(folder):
        return f"it is a data set; fit it with: mbtf-fit {folder}"
    content = _content(folder)
    if mesh := next((p for p in content if p.suffix.lower() in MESH_FILES), None):
        return f"did you mean '{mesh}'?"
    for below in (p for p in content if p.is_dir()):
        with contextlib.suppress(InputError):
            if any(role_of(p.name) == "height" for p in _images(below)):
                return f"did you mean '{below}'?"
    return next(filter(None, map(unpack, content)), "")


def _unread(folder: Path, files: list[Path]) -> str:
    """Images of formats that are not read, where no other format of them lies beside; empty without one."""
    stems = {path.stem.lower() for path in files}
    names = [p.name for p in _content(folder) if p.suffix.lower() in _UNREAD and p.stem.lower() not in stems]
    return f"not read: {_listed(names)}; save them as PNG, TIFF or EXR" if names else ""


def _listed(names: Iterable[str]) -> str:
    shown = list(names)
    return ", ".join(shown[:_LISTED]) + (f" and {len(shown) - _LISTED} more" if len(shown) > _LISTED else "")


def _no_heights(folder: Path, files: list[Path], shared: int, unread: str) -> InputError:
    nameless = [p.name for p in files if read_name(p.name, shared).content is None]
    words = (*WORDS["height"], *WEAK_WORDS["height"])
    hint = f"its name must contain one of: {', '.join(words)}; or name it in a material.yaml"
    if nameless:
        hint += f" (their names match no map: {_listed(nameless)})"
    return InputError(
        f"no height map among {_listed(p.name for p in files)}",
        where=folder,
        hint=_elsewhere(folder) or (f"{unread}; {hint}" if unread else hint),
    )
