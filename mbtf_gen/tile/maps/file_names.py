"""What the file names that texture libraries customarily use say of a map: its content, depth and variant."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import permutations, product
from pathlib import Path
from typing import Literal

Role = Literal["height", "base_color", "roughness", "metallic", "normal", "opacity"]
Convention = Literal["gl", "dx"]


@dataclass(frozen=True)
class Source:
    """What a file stores for a role.

    Attributes
    ----------
    role : the map
    channel : of the file; None: all that belongs together
    invert : whether it is 1 - x of the map, such as gloss for roughness
    rank : of several files of a role, one of smaller rank is preferred
    """

    role: Role
    channel: str | None = None
    invert: bool = False
    rank: int = 0


@dataclass(frozen=True)
class Unused:
    """Why a known map is not used, and whether the material lacks something without it."""

    reason: str
    lost: bool = True


# Words of file names that denote a map.
WORDS: dict[Role, tuple[str, ...]] = {
    "height": ("height", "heightmap", "displacement", "disp"),
    "base_color": ("basecolor", "basecolour", "albedo", "color", "colour", "col", "basemap"),
    "roughness": ("roughness", "rough", "rgh"),
    "metallic": ("metallic", "metalness", "metal"),
    "normal": ("normal", "normals", "nor", "nrm", "norm", "normalgl", "normalogl", "normaldx"),
    "opacity": ("opacity", "alpha"),
}
# Words that denote a map if no other file does.
WEAK_WORDS: dict[Role, tuple[str, ...]] = {
    "height": ("bump",),
    "base_color": ("diffuse", "diff"),
    "opacity": ("mask",),
}
GLOSS_WORDS = ("gloss", "glossiness", "smoothness")
# Letters of packed maps, in the order of their channels; those of ambient occlusion are not used.
LETTERS = ("arm", "orm", "rma", "mra", "mro", "rmo", "amr", "aorm", "mrao", "rmao")
_LETTER: dict[str, Role] = {"r": "roughness", "m": "metallic"}
_OCCLUSION = ("occlusion", "ambientocclusion", "ao")
# Words of Unity: metallic in red, smoothness (1 - roughness) in alpha.
SMOOTHNESS_IN_ALPHA = (
    *("maskmap", "mads", "metallicsmoothness", "metalsmoothness"),
    *("metallicgloss", "metallicglossiness"),
)
_NAME_IT = "name it in a material.yaml to use it"
_LAYERS = (
    *("coat", "clearcoat", "sheen", "fuzz", "emissive", "emission", "specular"),
    *("subsurface", "scattering", "transmission", "translucency"),
)
_SPACES = ("bent", "object", "objectspace", "world", "worldspace", "detail")
_CONVENTIONS: dict[str, Convention] = {
    **dict.fromkeys(("gl", "ogl", "opengl", "normalgl", "normalogl"), "gl"),
    **dict.fromkeys(("dx", "directx", "normaldx"), "dx"),
}
# The last words of files for a workflow; the other one's files are left out.
_WORKFLOWS = ("metalness", "specular")
_PIECE = re.compile(r"OpenGL|DirectX|[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
# In the pieces of a name, joined by blanks: 16 bits, as in ``DISP16``; a variant, as in ``COL_VAR2`` or
# ``col_02``, whose number is no depth, resolution or tile of a UDIM set; what does not tell maps apart.
_DEEP = re.compile(r"^16\b(?! k)(?: bit\b)?|\b16 bit\b")
_VARIANT = re.compile(r"^(?:var(?:iant|iation)? )?(?!(?:8|16|32)\b)(\d{1,2})\b(?! k| bit)")
_TAG = re.compile(rf"\b(?:\d+ (?:k|bit)|{'|'.join(_CONVENTIONS)})\b")
# Neighboring pieces of a name that are joined to a word, at most.
_JOINED = 4


def _known() -> dict[str, tuple[Source, ...] | Unused]:
    """What each word denotes; words of several pieces are joined."""
    out: dict[str, tuple[Source, ...] | Unused] = {}
    for rank, table in enumerate((WORDS, WEAK_WORDS)):
        out |= {word: (Source(role, rank=rank),) for role, words in table.items() for word in words}
    out |= {word: (Source("roughness", invert=True, rank=2),) for word in GLOSS_WORDS}
    out |= {word: _packed(word.replace("ao", "o")) for word in LETTERS}
    spelled = {"o": _OCCLUSION, "r": ("roughness",), "m": ("metallic", "metalness")}
    for order in permutations("orm"):
        words = product(*(spelled[letter] for letter in order))
        out |= dict.fromkeys(map("".join, words), _packed(order))
    # The map of glTF.
    gltf = (Source("roughness", "G", rank=1), Source("metallic", "B", rank=1))
    out |= dict.fromkeys(("metallicroughness", "metalnessroughness"), gltf)
    smooth = Source("roughness", "A", invert=True, rank=1)
    out |= dict.fromkeys(SMOOTHNESS_IN_ALPHA, (Source("metallic", "R", rank=1), smooth))
    for color, alpha in product(("albedo", "basecolor", "diffuse"), ("transparency", "opacity", "alpha")):
        out[color + alpha] = (Source("base_color"), Source("opacity", "A", rank=1))
    out |= _unused()
    # With "map" as a part of the word.
    return out | {f"{word}map": content for word, content in out.items() if f"{word}map" not in out}


def _packed(letters: Iterable[str]) -> tuple[Source, ...]:
    """Sources of a packed map. Files of one map are preferred to them."""
    channels = zip(letters, "RGB", strict=True)
    return tuple(Source(_LETTER[letter], c, rank=1) for letter, c in channels if letter in _LETTER)


def _unused() -> dict[str, Unused]:
    out: dict[str, Unused] = {}
    occlusion = Unused("the simulation computes ambient occlusion", lost=False)
    out |= dict.fromkeys((*_OCCLUSION, "occ", "mixedao"), occlusion)
    derived = Unused("it follows from the heights", lost=False)
    out |= dict.fromkeys(("cavity", "curvature", "position", "edge"), derived)
    out |= dict.fromkeys(("preview", "thumb", "thumbnail", "render"), Unused("it is a picture", lost=False))
    foreign = Unused("mbtf has no such map")
    out |= dict.fromkeys(_LAYERS, foreign)
    out |= dict.fromkeys(
        ("refl", "reflection", "translucent", "scatter", "sss", "thickness", "anisotropy", "ior"), foreign
    )
    out |= dict.fromkeys(("specular", "spec", "clearcoat", "sheen"), Unused(_NAME_IT))
    out |= dict.fromkeys(("transparency",), Unused("as opacity it may be inverted; " + _NAME_IT))
    # Two orders are in use.
    unclear = Unused("name its channels in a material.yaml, as in roughness: {file: …, channel: G}")
    packed = ("roughnessmetallic", "roughnessmetalness", "ord", "packed")
    out |= dict.fromkeys(packed, unclear)
    smooth = Unused("in its alpha may be gloss, in a material.yaml {file: …, channel: A, invert: true}")
    out |= dict.fromkeys(("specularsmoothness", "speculargloss", "specularglossiness", "specgloss"), smooth)
    contents = ("color", "roughness", "gloss", "normal", "weight", "opacity", "level", "mask")
    out |= {a + b: foreign for a, b in product(_LAYERS, contents) if a + b not in out}
    usable = product(("coat", "clearcoat", "sheen"), ("color", "roughness", "weight", "opacity"))
    out |= {a + b: Unused(_NAME_IT) for a, b in (*usable, ("specular", "level"))}
    normals = Unused("it is no tangent-space normal map of the surface")
    out |= {space + word: normals for space, word in product(_SPACES, ("normal", "normals"))}
    return out | dict.fromkeys(("normalbump", "normalobject", "normaldetail"), normals)


KNOWN = _known()


@dataclass(frozen=True)
class MapName:
    """What a file name says.

    Attributes
    ----------
    word : the last word that denotes a map; empty without one
    content : what it denotes; None without one
    rest : the other words, without depth, variant, convention, workflow and resolution: equal for two
        files of one map
    bare : whether it has no word but those that all names share
    convention : of a normal map
    deep : whether it names 16 bits
    variant : its number, such as 2 of ``COL_VAR2``; 0 without one
    workflow : ``metalness`` or ``specular`` if the name ends so behind the map and its resolution
    """

    word: str
    content: tuple[Source, ...] | Unused | None
    rest: tuple[str, ...]
    bare: bool
    convention: Convention | None
    deep: bool
    variant: int
    workflow: str | None


def tokens(name: str) -> list[str]:
    """Pieces of a file name without suffix, lower case: split at ``_ - .``, blanks, digits and camelCase."""
    return [piece.lower() for piece in _PIECE.findall(Path(name).stem)]


def read_name(name: str, shared: int = 0) -> MapName:
    """Read a file name, in which the first `shared` pieces name the material, not a map."""
    pieces = tokens(name)
    workflow = None
    if pieces[-2:-1] == ["k"] and pieces[-1] in _WORKFLOWS and _last_word(pieces[:-3], shared) is not None:
        workflow = pieces.pop()
    start, end = _last_word(pieces, shared) or (len(pieces), len(pieces))
    word, behind = "".join(pieces[start:end]), " ".join(pieces[end:])
    convention = next((_CONVENTIONS[piece] for piece in pieces if piece in _CONVENTIONS), None)
    variant = _VARIANT.match(behind)
    rest = [*pieces[:start], *_VARIANT.sub("", _DEEP.sub("", behind)).split()]
    return MapName(
        word=word,
        content=KNOWN.get(word),
        rest=tuple(_TAG.sub("", " ".join(rest)).split()),
        bare=len(pieces) <= shared,
        convention=convention,
        deep=_DEEP.search(behind) is not None,
        variant=int(variant[1]) if variant else 0,
        workflow=workflow,
    )


def _last_word(pieces: list[str], shared: int) -> tuple[int, int] | None:
    """(first piece, end) of the last word that denotes a map; of those that end there, the longest."""
    for end in range(len(pieces), shared, -1):
        for start in range(max(shared, end - _JOINED), end):
            if "".join(pieces[start:end]) in KNOWN:
                return start, end
    return None


def role_of(name: str, shared: int = 0) -> Role | None:
    """Role of a file by the **last** word of its name that denotes a map, without `shared` leading pieces.

    ``metal_plate_disp.png`` contains heights and ``rock_height_mask.png`` opacity. None without such a word,
    or where it denotes a packed map or one that is not used.
    """
    content = read_name(name, shared).content
    if isinstance(content, tuple) and len(content) == 1:
        return content[0].role
    return None


def normal_convention(name: str) -> Convention | None:
    """``gl`` or ``dx`` if a normal map's name contains it."""
    return read_name(name).convention
