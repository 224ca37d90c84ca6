"""Recognition of maps by the file names that texture libraries customarily use."""

from __future__ import annotations

import contextlib
import re
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path
from typing import Literal

from mbtf_core.errors import InputError
from mbtf_core.images.read import SUFFIXES, is_image

Role = Literal["height", "base_color", "roughness", "metallic", "normal", "opacity"]
Convention = Literal["gl", "dx"]

# Words of file names that denote a map.
WORDS: dict[Role, tuple[str, ...]] = {
    "height": ("height", "heightmap", "displacement", "disp", "bump"),
    "base_color": ("basecolor", "basecolour", "albedo", "color", "colour", "col", "diffuse", "diff"),
    "roughness": ("roughness", "rough", "rgh"),
    "metallic": ("metallic", "metalness", "metal"),
    "normal": ("normal", "normals", "nor", "nrm", "normalgl", "normaldx"),
    "opacity": ("opacity", "alpha", "mask"),
}
_ROLES: dict[str, Role] = {word: role for role, words in WORDS.items() for word in words}
# Words of packed maps → their channels of roughness and metallic.
_PACKED = {
    **dict.fromkeys(("arm", "orm", "metallicroughness", "roughnessmetallic"), ("G", "B")),
    "rma": ("R", "G"),
}
_GLOSS = ("gloss", "glossiness")
# Words of maps that are known but not used, and the reason.
UNUSED: dict[str, str] = {
    **dict.fromkeys(("ao", "occlusion"), "the simulation computes ambient occlusion"),
    **dict.fromkeys(_PACKED, "name its channels in a material.yaml, as in roughness: {file: …, channel: G}"),
    **dict.fromkeys(("specular", "spec"), "name it in a material.yaml to use it"),
    **dict.fromkeys(_GLOSS, "in a material.yaml it is roughness: {file: …, invert: true}"),
    **dict.fromkeys(("emissive", "emission", "preview", "thumb"), "mbtf does not use it"),
}
# Neighboring words that are one.
_JOINED = {
    (first, second): "metallicroughness" if second == "roughness" else "roughnessmetallic"
    for metal in ("metallic", "metalness")
    for first, second in ((metal, "roughness"), ("roughness", metal))
}
_ARCHIVES = (".zip", ".7z", ".rar", ".tar", ".tgz", ".gz")
# Names listed in a message.
_LISTED = 6
_PIECE = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")


@dataclass(frozen=True)
class FoundMaps:
    """Maps found in a folder.

    Attributes
    ----------
    maps : file of each role
    unused : reason why an image is not used, by file name
    notes, warnings : messages for the user
    """

    maps: dict[Role, Path] = field(default_factory=dict)
    unused: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def tokens(name: str) -> list[str]:
    """Words of a file name without suffix, lower case: split at ``_ - .``, blanks, digits and camelCase."""
    return [piece.lower() for piece in _PIECE.findall(Path(name).stem)]


def role_of(name: str, shared: int = 0) -> Role | None:
    """Role of a file by the **last** word of its name that denotes a map, without `shared` leading words.

    ``metal_plate_disp.png`` contains heights and ``rock_height_mask.png`` opacity. None without such a word,
    or where it denotes a map that is not used.
    """
    return _ROLES.get(_last_word(name, shared) or "")


def _last_word(name: str, shared: int = 0) -> str | None:
    words = tokens(name)[shared:]
    for i in reversed(range(len(words))):
        if i and (words[i - 1], words[i]) in _JOINED:
            return _JOINED[words[i - 1], words[i]]
        if words[i] in _ROLES or words[i] in UNUSED:
            return words[i]
    return None


def _shared_words(names: list[str]) -> int:
    """Number of leading words that all of several names share: they name the material, not a map."""
    columns = zip(*map(tokens, names), strict=False)
    return sum(1 for _ in takewhile(lambda words: len(set(words)) == 1, columns)) if len(names) > 1 else 0


def normal_convention(name: str) -> Convention | None:
    """``gl`` or ``dx`` if a normal map's name contains it."""
    words = set(tokens(name))
    if words & {"gl", "opengl", "normalgl"}:
        return "gl"
    return "dx" if words & {"dx", "directx", "normaldx"} else None


def find_maps(folder: Path) -> FoundMaps:
    """Find the maps in a folder, without its subfolders.

    Leading words that all names share are ignored, unless only they denote a height map: of ``Metal004.png``
    and ``Metal004_Color.png`` the former is a picture of the material. An OpenGL normal map is preferred.

    Raises
    ------
    InputError
        The folder is unreadable, has no image or no height map, or two candidates for one map.
    """
    files = _images(folder)
    if not files:
        raise InputError(
            "the folder contains no image",
            where=folder,
            hint=_elsewhere(folder) or f"a height map is required ({', '.join(SUFFIXES)})",
        )
    shared = _shared_words([p.name for p in files])
    if not any(role_of(p.name, shared) == "height" for p in files):
        if not any(role_of(p.name) == "height" for p in files):
            raise _no_heights(folder, files, shared)
        shared = 0
    candidates: dict[Role, list[Path]] = {}
    unused: dict[str, str] = {}
    for path in files:
        word = _last_word(path.name, shared)
        if word in _ROLES:
            candidates.setdefault(_ROLES[word], []).append(path)
        else:
            unused[path.name] = UNUSED.get(word or "", "its name matches no map")
    normals = candidates.get("normal", [])
    gl = [p for p in normals if normal_convention(p.name) == "gl"]
    if len(normals) > 1 and len(gl) == 1:
        candidates["normal"] = gl
        unused |= {p.name: f"{gl[0].name} is the normal map" for p in normals if p != gl[0]}
    for role, paths in candidates.items():
        if len(paths) > 1:
            raise InputError(
                f"two maps of {role}: {paths[0].name} and {paths[1].name}",
                where=folder,
                hint="remove one, or say which is meant in a material.yaml",
            )
    maps = {role: paths[0] for role, paths in candidates.items()}
    lost = (_lost_warning(folder / name, _last_word(name, shared), maps) for name in unused)
    notes = [f"{name} is not used: {why}" for name, why in unused.items()]
    return FoundMaps(maps, unused, notes, [text for text in lost if text is not None])


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
    """Hint at another place of the maps: an archive, or a subfolder with a height map."""
    content = _content(folder)
    for below in (p for p in content if p.is_dir()):
        with contextlib.suppress(InputError):
            if any(role_of(p.name) == "height" for p in _images(below)):
                return f"did you mean '{below}'?"
    return next(filter(None, map(unpack, content)), "")


def _no_heights(folder: Path, files: list[Path], shared: int) -> InputError:
    def listed(names: list[str]) -> str:
        return ", ".join(names[:_LISTED]) + (", …" if len(names) > _LISTED else "")

    nameless = [p.name for p in files if _last_word(p.name, shared) is None]
    hint = f"its name must contain one of: {', '.join(WORDS['height'])}; or name it in a material.yaml"
    if nameless:
        hint += f" (their names match no map: {listed(nameless)})"
    return InputError(
        f"no height map among {listed([p.name for p in files])}",
        where=folder,
        hint=_elsewhere(folder) or hint,
    )


def _lost_warning(path: Path, word: str | None, maps: dict[Role, Path]) -> str | None:
    """The warning that an unused image contains a missing map."""
    options: dict[Role, str] = {}
    if word in _PACKED:
        roughness, metallic = _PACKED[word]
        options = {"roughness": f"channel: {roughness}", "metallic": f"channel: {metallic}"}
    elif word in _GLOSS:
        options = {"roughness": "invert: true"}
    entries = [f"{r}: {{file: {path.name}, {option}}}" for r, option in options.items() if r not in maps]
    if not entries:
        return None
    lambert = "roughness" not in maps and "metallic" not in maps
    return (
        f"{path}: is not used, {'so that the surface is Lambert' if lambert else 'and its map is missing'}; "
        f"a material.yaml that names all maps can use it: {', '.join(entries)}"
    )
