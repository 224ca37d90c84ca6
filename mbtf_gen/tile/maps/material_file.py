"""Schema of ``material.yaml``: maps and constants of a material."""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from mbtf_core.config.settings import FileName, Settings
from mbtf_core.data.schema import Tiling
from mbtf_core.images.color_spaces import ColorSpace
from mbtf_gen.config.generator import MAX_SCALE, Resolution, Rgb, Share

Channel = Annotated[str, Field(min_length=1)]
_CHANNEL = "channel or layer of an EXR file; R, G, B, A or Y of others; default: all that belongs together"


class _Entry(Settings):
    @model_validator(mode="before")
    @classmethod
    def _long(cls, data: Any) -> Any:
        """Long form of ``roughness: 0.4`` and ``roughness: rough.png``."""
        if isinstance(data, str):
            return {"file": data}
        if isinstance(data, int | float | Sequence) and not isinstance(data, bool):
            return {"value": data}
        return data


class HeightEntry(_Entry):
    """The height map."""

    file: FileName = Field(description="the height map")
    channel: Channel | None = Field(None, description=_CHANNEL)
    scale: float | None = Field(
        None,
        ge=-MAX_SCALE,
        le=MAX_SCALE,
        description="factor on the stored heights, tile widths; default 1 for floats, 0.05 for integers",
    )
    dequantize: bool = Field(True, description="smooth quantized heights within half a quantization step")
    colorspace: ColorSpace = Field("linear", description="srgb decodes the stored numbers first")


class _FileOrValue(_Entry):
    file: FileName | None = Field(None, description="the map; either this or value")
    channel: Channel | None = Field(None, description=_CHANNEL)

    @model_validator(mode="after")
    def _one(self) -> _FileOrValue:
        if (self.file is None) == (getattr(self, "value", None) is None):
            raise ValueError("needs either 'file' or 'value'")
        if self.file is None and self.channel is not None:
            raise ValueError("'channel' goes with 'file'")
        return self


class ColorEntry(_FileOrValue):
    """A color map or one color."""

    value: Rgb | None = Field(None, description="one color, three numbers or one")
    colorspace: ColorSpace | None = Field(
        None,
        description="default: as the file declares, else srgb for integer images, linear for float images; "
        "linear for values",
    )


class ShareEntry(_FileOrValue):
    """A map of numbers in [0, 1] or one number."""

    value: Share | None = Field(None, description="one number")
    colorspace: ColorSpace = Field("linear", description="srgb decodes the stored numbers of a map first")
    invert: bool = Field(False, description="take 1 - x of a map, such as gloss for roughness")

    @model_validator(mode="after")
    def _of_a_map(self) -> ShareEntry:
        if self.file is None and (self.invert or self.colorspace != "linear"):
            raise ValueError("'invert' and 'colorspace' go with 'file'")
        return self


class NormalEntry(_Entry):
    """A tangent-space normal map."""

    file: FileName = Field(description="the normal map")
    channel: Channel | None = Field(None, description="layer of an EXR file")
    convention: Literal["gl", "dx"] | None = Field(
        None, description="green up (gl) or down (dx); default: as the heights' slopes show, else by the name"
    )


@dataclass(frozen=True)
class Role:
    """What a map, or a constant in its place, does to the simulation.

    Attributes
    ----------
    effect : the effect that needs it; empty for the base layer. The weight of an effect has its name
    default : value where the effect is there and the map is not
    layer : of a layer's weight, the layer in words
    lobe : width in radians of the lobe of a roughness
    """

    effect: str = ""
    default: float | None = None
    layer: str = ""
    lobe: Callable[[float], float] | None = None


def _ggx(roughness: float) -> float:
    """A lobe of GGX is about 2α wide."""
    return 2.0 * roughness**2


def _fibers(roughness: float) -> float:
    """The fibers of sheen lean by less than about √α."""
    return roughness


# What each map of a material does, by role, in the order of the file.
ROLES = {
    "base_color": Role(),
    "roughness": Role(lobe=_ggx),
    "metallic": Role("metallic"),
    "specular": Role("specular"),
    "clearcoat": Role("clearcoat", layer="a clear coat"),
    "clearcoat_roughness": Role("clearcoat", 0.1, lobe=_ggx),
    "sheen": Role("sheen", layer="a sheen"),
    "sheen_color": Role("sheen"),
    "sheen_roughness": Role("sheen", 0.3, lobe=_fibers),
    "normal": Role("normal"),
    "opacity": Role("opacity"),
}
# Effects of maps that a BSDF does not replace, and those of how the surface reflects.
_BESIDE = ("normal", "opacity")
REFLECTING = tuple(dict.fromkeys(r.effect for r in ROLES.values() if r.effect not in ("", *_BESIDE)))
# Defaults of a glossy surface, once one of them is given.
LOBES = {"roughness": 0.5, "metallic": 0.0, "specular": 0.5}


class MaterialFile(Settings):
    """Content of a ``material.yaml``; file names are relative to its folder."""

    height: HeightEntry = Field(description="heights; the only required key")
    base_color: ColorEntry | None = Field(None, description="color; default: linear gray 0.5")
    roughness: ShareEntry | None = Field(None, description="0 mirror to 1; default 0.5 once one is given")
    metallic: ShareEntry | None = Field(None, description="0 dielectric to 1 metal; default 0")
    specular: ShareEntry | None = Field(None, description="strength of the dielectric lobe; default 0.5")
    clearcoat: ShareEntry | None = Field(None, description="weight of a clear coat on top; default 0")
    clearcoat_roughness: ShareEntry | None = Field(
        None, description="roughness of the clear coat; default 0.1"
    )
    sheen: ShareEntry | None = Field(None, description="weight of a sheen on top; default 0")
    sheen_color: ColorEntry | None = Field(None, description="color of the sheen; default white")
    sheen_roughness: ShareEntry | None = Field(None, description="roughness of the sheen; default 0.3")
    normal: NormalEntry | None = Field(None, description="tangent-space normal map")
    opacity: ShareEntry | None = Field(None, description="1 opaque to 0 hole; default: opaque")
    bsdf: dict[str, Any] | None = Field(
        None, description="Mitsuba BSDF that replaces the maps, passed to Mitsuba unchanged"
    )
    make_tileable: Tiling | None = Field(
        None,
        description="method for maps that do not tile: 2 x 2 mirrored copies, or blended edges; "
        "default: none",
    )
    resolution: Resolution | None = Field(
        None,
        description="texels across at the finest level, a power of two; default: from the map's width",
    )

    @model_validator(mode="after")
    def _bsdf_alone(self) -> MaterialFile:
        given = [
            n for n, role in ROLES.items() if role.effect not in _BESIDE and getattr(self, n) is not None
        ]
        if self.bsdf is not None and given:
            raise ValueError(f"'bsdf' replaces {', '.join(given)}; give one or the other")
        for name, role in ROLES.items():
            if role.effect and getattr(self, name) is not None and getattr(self, role.effect) is None:
                raise ValueError(f"'{name}' goes with '{role.effect}'")
        if self.bsdf is not None and not isinstance(self.bsdf.get("type"), str):
            raise ValueError("'bsdf' needs a 'type', such as diffuse")
        return self

    def tiling(self, given: Tiling | None) -> Tiling:
        """Method for maps that do not tile: the given one, else that of the file, else ``none``."""
        return given or self.make_tileable or "none"


def layers_above(given: Container[str]) -> str:
    """``" under a clear coat and a sheen"``, as far as they are among the given roles."""
    texts = [role.layer for name, role in ROLES.items() if role.layer and name in given]
    return f" under {' and '.join(texts)}" if texts else ""
