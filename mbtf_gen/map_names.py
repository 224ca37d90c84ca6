"""Which file of a folder is which map, by the names that texture libraries customarily use."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from .errors import InputError
from .images import SUFFIXES, is_image

Role = Literal["height", "basecolor", "roughness", "metallic", "normal", "opacity"]
Convention = Literal["gl", "dx"]

# Words of file names that mean a map.
WORDS: dict[Role, tuple[str, ...]] = {
    "height": ("height", "heightmap", "displacement", "disp", "bump"),
    "basecolor": ("basecolor", "basecolour", "albedo", "color", "colour", "col", "diffuse", "diff"),
    "roughness": ("roughness", "rough", "rgh"),
    "metallic": ("metallic", "metalness", "metal"),
    "normal": ("normal", "normals", "nor", "nrm", "normalgl", "normaldx"),
    "opacity": ("opacity", "alpha", "mask"),
}
_ROLES: dict[str, Role] = {word: role for role, words in WORDS.items() for word in words}
# Words of maps that are known but not used by themselves, and why.
UNUSED: dict[str, str] = {
    **dict.fromkeys(("ao", "occlusion"), "ambient occlusion comes out of the simulation"),
    **dict.fromkeys(
        ("arm", "orm", "rma"), "name its channels in a material.yaml, as in roughness: {file: …, channel: G}"
    ),
    **dict.fromkeys(("specular", "spec"), "name it in a material.yaml to use it"),
    **dict.fromkeys(("gloss", "glossiness"), "in a material.yaml it is roughness: {file: …, invert: true}"),
    **dict.fromkeys(("emissive", "emission", "preview", "thumb"), "it has no use here"),
}
_PIECE = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")


@dataclass(frozen=True)
class FoundMaps:
    """Maps found in a folder, and remarks about images that are not used."""

    maps: dict[Role, Path]
    notes: list[str]


def tokens(name: str) -> list[str]:
    """Words of a file name without suffix, lower case: split at ``_ - .``, blanks, digits and camelCase."""
    return [piece.lower() for piece in _PIECE.findall(Path(name).stem)]


def role_of(name: str) -> Role | None:
    """What a file's name says it holds: the **last** word that means a map decides.

    So ``metal_plate_disp.png`` holds heights and ``rock_height_mask.png`` opacity. None where no word does,
    or the last one means a map that is not used.
    """
    word = _last_word(name)
    return _ROLES.get(word) if word else None


def _last_word(name: str) -> str | None:
    return next((t for t in reversed(tokens(name)) if t in _ROLES or t in UNUSED), None)


def normal_convention(name: str) -> Convention | None:
    """``gl`` or ``dx`` where a normal map's name says so."""
    words = tokens(name)
    if any(w in ("gl", "opengl", "normalgl") for w in words):
        return "gl"
    return "dx" if any(w in ("dx", "directx", "normaldx") for w in words) else None


def find_maps(folder: Path) -> FoundMaps:
    """Maps in a folder, not below it.

    Of two normal maps of which one is named for OpenGL that one is taken.

    Raises
    ------
    InputError : the folder cannot be read, holds no image, no height map, or two candidates for one map
    """
    try:
        files = sorted(
            p for p in folder.iterdir() if p.is_file() and is_image(p) and not p.name.startswith(".")
        )
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=folder) from None
    if not files:
        raise InputError(
            "the folder holds no image", where=folder, cure=f"a height map is wanted ({', '.join(SUFFIXES)})"
        )
    candidates: dict[Role, list[Path]] = {}
    notes, unnamed = [], []
    for path in files:
        role, word = role_of(path.name), _last_word(path.name)
        if role is not None:
            candidates.setdefault(role, []).append(path)
        elif word is not None:
            notes.append(f"{path.name} is not used: {UNUSED[word]}")
        else:
            unnamed.append(path.name)
    if unnamed:
        notes.append(f"not used, their names say no map: {', '.join(unnamed)}")
    maps: dict[Role, Path] = {}
    for role, paths in candidates.items():
        gl = [p for p in paths if normal_convention(p.name) == "gl"]
        if role == "normal" and len(paths) > 1 and len(gl) == 1:
            notes.append(
                f"{gl[0].name} is the normal map; {', '.join(p.name for p in paths if p != gl[0])} is left"
            )
            paths = gl
        if len(paths) > 1:
            raise InputError(
                f"two maps of {role}: {paths[0].name} and {paths[1].name}",
                where=folder,
                cure="remove one, or say which is meant in a material.yaml",
            )
        maps[role] = paths[0]
    if "height" not in maps:
        raise InputError(
            f"no height map among {', '.join(p.name for p in files[:6])}",
            where=folder,
            cure=f"its name must hold one of: {', '.join(WORDS['height'])}",
        )
    return FoundMaps(maps, notes)
