"""Materials of OBJ files: the ``.mtl`` format with the common extension for physically based materials."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.errors import InputError
from mbtf_core.meshes.companions import Companions
from mbtf_core.meshes.content import Texture, read_bytes

# Numbers after options of images, at most; all other options take one word.
_NUMBERS = {"-o": 3, "-s": 3, "-t": 3, "-mm": 2}
_CHANNELS = {"r": "R", "g": "G", "b": "B", "m": "A", "l": None}
# Statements that change nothing alone: ambient light, the choice of a renderer's formula, and parameters of
# layers that are reported with their weight (Ks, aniso).
_IDLE = {"ka", "illum", "sharpness", "ni", "ns", "anisor", "map_ka", "map_aat"}
# Role of each statement, and of the image with the prefix map_.
_ROLES = {
    "base_color": "Kd",
    "roughness": "Pr",
    "metallic": "Pm",
    "clearcoat": "Pc",
    "clearcoat_roughness": "Pcr",
    "sheen": "Ps",
    "opacity": "d",
}
_USED = {"tr", *(prefix + key.lower() for key in _ROLES.values() for prefix in ("", "map_"))}


@dataclass(frozen=True)
class MtlMaterial:
    """Statements of one material of a file: keyword, the rest of the line and its number, by keyword in lower
    case."""

    name: str
    path: Path
    statements: dict[str, tuple[str, str, int]] = field(default_factory=dict)

    def number(self, key: str, count: int = 1) -> Any:
        """Number or color (3,) in [0, 1] of a statement; None where it is missing, an InputError where it is
        something else."""
        if key not in self.statements:
            return None
        _, text, line = self.statements[key]
        where = f"{self.path}, line {line}"
        try:
            values = [float(word) for word in text.split()]
        except ValueError:
            raise InputError(f"'{text}' is no number", where=where, hint=_GIVE) from None
        if len(values) not in {1, count} or not all(0.0 <= v <= 1.0 for v in values):
            raise InputError(f"'{text}' is not {_wanted(count)} in [0, 1]", where=where, hint=_GIVE)
        return values[0] if count == 1 else np.broadcast_to(np.array(values), count).copy()


_GIVE = "correct it, or give the value in a material.yaml"


def _wanted(count: int) -> str:
    return "a number" if count == 1 else "a color of three numbers"


def read_mtl(path: Path, found: dict[str, MtlMaterial], warnings: list[str]) -> None:
    """Read a file of materials and add them, and warnings; of several of one name the first counts. An
    InputError where it cannot be read, or is no text."""
    data = read_bytes(path)
    if b"\0" in data:
        raise InputError("is not a text of materials", where=path)
    current: MtlMaterial | None = None
    for number, line in enumerate(as_text(data).splitlines(), 1):
        key, _, rest = line.partition("#")[0].strip().replace("\t", " ").partition(" ")
        rest = rest.strip()
        if key.lower() == "newmtl":
            current = MtlMaterial(rest, path)
            if rest in found:
                warnings.append(f"{path.name}: '{rest}' is there twice; the first one counts")
            else:
                found[rest] = current
        elif key and current is not None:
            current.statements[key.lower()] = key, rest, number
        elif key:
            warnings.append(f"{path.name}, line {number}: '{key}' before the first material is not used")


def as_text(data: bytes) -> str:
    """Text in UTF-8, with or without a byte order mark, or else in Latin-1."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def material_values(
    material: MtlMaterial, companions: Companions
) -> tuple[dict[str, Any], dict[str, InputError], list[str]]:
    """What a material says, by role: values and faults as of :class:`~mbtf_core.meshes.content.MeshShape`,
    and warnings without the name of the material.

    ``Kd`` is linear and multiplies ``map_Kd``, as other numbers multiply their images. `companions` finds the
    images, and collects them and warnings of them.
    """
    values: dict[str, Any] = {}
    faults: dict[str, InputError] = {}
    remarks: list[str] = []

    def read(role: str, key: str, one: Any) -> None:
        image = material.statements.get(f"map_{key.lower()}")
        try:
            factor = material.number(key.lower(), np.size(one))
            if image is None:
                if factor is not None:
                    values[role] = factor
                return
            options = _image_options(image[1], f"{material.path}, line {image[2]}")
            if options.unused:
                remarks.append(f"{' '.join(options.unused)} of map_{key} is not used")
            if factor is not None and not np.any(factor):
                remarks.append(f"{key} 0 makes map_{key} black")
            elif factor is not None and np.min(factor) < 1.0 and role == "base_color":
                remarks.append(f"{key} {material.statements[key.lower()][1]} darkens map_{key}")
            if role == "base_color":
                pixels = companions.color(options.name)
            else:
                pixels = companions.share(options.name, options.channel, alpha=role == "opacity")
            texture = Texture(pixels, (options.wrap, options.wrap), to_uv=options.to_uv)
            values[role] = texture, one if factor is None else factor
        except InputError as fault:
            faults[role] = fault

    for role, key in _ROLES.items():
        read(role, key, np.ones(3) if role == "base_color" else 1.0)
    if "base_color" not in {*values, *faults}:
        remarks.append("there is neither Kd nor map_Kd")
    for role in ("clearcoat", "sheen"):
        if not isinstance(values.get(role), tuple) and not values.get(role):
            values.pop(role, None)
            values.pop(f"{role}_roughness", None)
    _transparency(material, values, remarks)
    keys = material.statements.keys() - _USED - _IDLE
    unused = sorted(material.statements[key][0] for key in keys if _says(key, material.statements[key][1]))
    if unused:
        remarks.append(f"{', '.join(unused)} {'is' if len(unused) == 1 else 'are'} not used")
    return values, faults, remarks


def _transparency(material: MtlMaterial, values: dict[str, Any], remarks: list[str]) -> None:
    """Opacity that hides nothing is left out; ``Tr`` is its complement, where there is no ``d``."""
    if "opacity" not in values and "tr" in material.statements:
        through = material.number("tr")
        values["opacity"] = 1.0 - through
        if through == 1.0:
            # Some programs write the opacity itself.
            remarks.append("Tr 1, which would hide it, is not used")
            del values["opacity"]
    opacity = values.get("opacity")
    if opacity == 1.0:
        del values["opacity"]
    elif opacity == 0.0:
        remarks.append("d 0 hides it")


def _says(key: str, text: str) -> bool:
    """Whether a statement has another value than that of no effect."""
    numbers = [_number(word) for word in text.split()]
    return any(number != (1.0 if key == "tf" else 0.0) for number in numbers)


@dataclass
class _ImageOptions:
    """Name of an image and options before it."""

    name: str = ""
    scale: list[float] = field(default_factory=lambda: [1.0, 1.0])
    offset: list[float] = field(default_factory=lambda: [0.0, 0.0])
    wrap: Any = "repeat"
    channel: str | None = None
    unused: list[str] = field(default_factory=list)

    @property
    def to_uv(self) -> Any:
        """Texture coordinates are scaled, then moved."""
        return np.column_stack([np.diag(self.scale), self.offset])


def _image_options(text: str, where: str) -> _ImageOptions:
    """Options and name of an image, such as ``-s 4 4 1 my bricks.png``."""
    out, rest = _ImageOptions(), text.strip()
    while option := re.match(r"(-[a-z]+)\s+", rest):
        name, rest = option[1], rest[option.end() :]
        if name in _NUMBERS:
            numbers: list[float] = []
            while len(numbers) < _NUMBERS[name] and (word := re.match(r"(\S+)\s+", rest)):
                number = _number(word[1])
                if number is None:
                    break
                numbers.append(number)
                rest = rest[word.end() :]
            if not numbers or not all(map(math.isfinite, numbers)):
                raise InputError(f"'{name}' of '{text}' needs numbers", where=where)
            # Numbers that are left out keep their defaults.
            if name == "-s":
                out.scale[: len(numbers)] = numbers[:2]
            elif name == "-o":
                out.offset[: len(numbers)] = numbers[:2]
            elif numbers != [0.0, 1.0][: len(numbers)] if name == "-mm" else any(numbers):
                out.unused.append(name)
            continue
        value, _, rest = rest.partition(" ")
        rest = rest.lstrip()
        if name == "-clamp":
            out.wrap = "clamp" if value == "on" else "repeat"
        elif name == "-imfchan" and value in _CHANNELS:
            out.channel = _CHANNELS[value]
        elif (name, value) not in {("-blendu", "on"), ("-blendv", "on"), ("-cc", "off")}:
            out.unused.append(name)
    out.name = rest.strip('"')
    if not out.name:
        raise InputError(f"'{text}' names no image", where=where)
    return out


def _number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None
