"""Schema of a ``material.yaml`` that describes cloth: a weave, a knit, or a file of yarns or fibers."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cached_property
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, model_validator

from mbtf_core.color import srgb_to_linear
from mbtf_core.config.settings import FileName, Settings
from mbtf_core.data.schema import Tiling
from mbtf_core.errors import InputError
from mbtf_core.paths import suggest_name
from mbtf_gen.config.generator import Positive, Resolution, Rgb, no_tiling
from mbtf_gen.tile.fibers.draft import Weave, colors_of, parse_draft, parse_sequence
from mbtf_gen.tile.fibers.yarn import YarnName

# Files that can be given in place of a material file, by suffix, with the key that names them there.
CURVE_FILES = {".pyp": "pattern", ".bcc": "curves", ".curves": "curves", ".txt": "curves"}
# Exactly one of them describes the cloth.
CLOTH_KEYS = {"weave", "knit", "pattern", "curves"}
# Keys of weaves alone.
_WOVEN = ("repeat", "yarns", "warp", "weft")
YarnKey = Annotated[str, Field(pattern=r"^[A-Za-z_]{1,32}$")]


def _decoded(value: Any) -> Any:
    """Linear color of ``#rrggbb``."""
    if not isinstance(value, str):
        return value
    if not re.fullmatch(r"#[0-9A-Fa-f]{6}", value):
        raise ValueError("must be '#rrggbb' in quotes (sRGB), one linear number, or three")
    return tuple(float(srgb_to_linear(byte / 255.0)) for byte in bytes.fromhex(value[1:]))


# Linear; three numbers, one for gray, or sRGB as #rrggbb.
Color = Annotated[Rgb, BeforeValidator(_decoded)]


class YarnEntry(Settings):
    """One kind of yarn, and how its fibers scatter light."""

    type: YarnName = Field("cotton2", description="published yarn: its plies, fibers, twist and flyaways")
    color: Color = Field(
        (0.7, 0.7, 0.7), description="color of a mass of its fibers: linear, or sRGB as '#rrggbb'"
    )
    width: Positive | None = Field(
        None,
        description="width over the distance of neighboring yarns, default 0.95 woven and 0.45 knitted; over "
        "that of the file for a pattern, default 1",
    )
    height: Annotated[float, Field(gt=0, le=4)] | None = Field(
        None, description="height over width; default 0.6 woven, else 1"
    )
    fibers: Annotated[int, Field(ge=1, le=100_000)] | None = Field(
        None, description="fibers of a ply; default: those of the type"
    )
    radius: Annotated[float, Field(gt=0, le=100)] = Field(
        1.0, description="factor on the radius of the fibers of the type"
    )
    flyaways: Annotated[float, Field(ge=0, le=100)] = Field(
        1.0, description="factor on the number of loops and hairs of the type"
    )
    # Mitsuba loses light and overflows below.
    roughness: Annotated[float, Field(ge=0.08, le=1)] | None = Field(
        None, description="longitudinal roughness of the fibers; default: that of the type's material"
    )
    azimuthal_roughness: Annotated[float, Field(ge=0.02, le=1)] | None = Field(
        None, description="azimuthal roughness of the fibers; default: that of the type's material"
    )
    scale_tilt: Annotated[float, Field(ge=-10, le=10)] = Field(
        0.0, description="tilt of the scales of the fibers in degrees"
    )
    ior: Annotated[float, Field(ge=1.1, le=2)] = Field(1.55, description="index of refraction of the fibers")

    def updated(self, other: YarnEntry) -> YarnEntry:
        """This entry with the keys that another one gives."""
        return self.model_copy(update={key: getattr(other, key) for key in other.model_fields_set})


def _entry(value: Any) -> Any:
    """A color alone as an entry."""
    return value if isinstance(value, Mapping | YarnEntry) else {"color": value}


class KnitEntry(Settings):
    """A stockinette."""

    stitches: Annotated[int, Field(ge=1, le=256)] = Field(4, description="stitches across the tile")
    rows: Annotated[int, Field(ge=1, le=256)] = Field(4, description="rows up the tile")
    # Loops of other shapes pass through one another.
    aspect: Annotated[float, Field(ge=0.72, le=0.85)] = Field(
        0.8, description="height of a stitch over its width"
    )


class ClothFile(Settings):
    """Content of a ``material.yaml`` of cloth; file names are relative to its folder."""

    weave: str | None = Field(
        None,
        max_length=100_000,
        description="plain, basket n, twill over/under, satin n/step, herringbone over/under width, "
        "houndstooth, gingham n, denim, or rows of X (warp above) and . (weft above)",
    )
    knit: KnitEntry | None = Field(None, description="a stockinette")
    pattern: FileName | None = Field(None, description="a periodic yarn pattern (.pyp)")
    curves: FileName | None = Field(
        None, description="fibers as curves: .bcc, or text of Mitsuba's bsplinecurve (.curves, .txt)"
    )
    repeat: Annotated[int, Field(ge=1, le=64)] = Field(
        1, description="repeats of a weave along each side of the tile, with other fibers each"
    )
    period: tuple[Positive, Positive] | None = Field(
        None,
        description="width and height of one period of `curves`, in the file's units; default: its bounds",
    )
    yarn: YarnEntry = Field(YarnEntry(), description="all yarns")
    yarns: dict[YarnKey, Annotated[YarnEntry, BeforeValidator(_entry)]] = Field(
        {}, max_length=26, description="yarns of a weave by name: colors, or what differs from `yarn`"
    )
    warp: str | None = Field(
        None,
        max_length=10_000,
        description="names of the warps' `yarns` from u = 0, with numbers, such as red4 white2; "
        "red/4 white2 blue/6 reverses at both ends",
    )
    weft: str | None = Field(
        None, max_length=10_000, description="the same of the wefts, from v → 1; default: as the warps"
    )
    seed: Annotated[int, Field(ge=0, lt=1 << 32)] = Field(0, description="random numbers of the fibers")
    resolution: Resolution = Field(128, description="texels across at the finest level, a power of two")

    @model_validator(mode="after")
    def _one(self) -> ClothFile:
        given = [key for key in sorted(CLOTH_KEYS) if getattr(self, key) is not None]
        if len(given) != 1:
            raise ValueError(
                f"needs one of weave, knit, pattern, curves, not {' and '.join(given) or 'none'}"
            )
        unused = {"width", "height", "fibers", "flyaways"} & self.yarn.model_fields_set
        if self.curves is not None and unused:
            raise ValueError(f"'yarn.{min(unused)}' does not apply to 'curves', which are fibers")
        if self.curves is not None and "seed" in self.model_fields_set:
            raise ValueError("'seed' does not apply to 'curves', which are fibers")
        if self.warp is None and self.weft is not None:
            raise ValueError("'weft' goes with 'warp'")
        for key, owner in (*((key, "weave") for key in _WOVEN), ("period", "curves")):
            if key in self.model_fields_set and given != [owner]:
                raise ValueError(f"'{key}' goes with '{owner}'")
        return self

    def tiling(self, given: Tiling | None) -> Tiling:
        """Method for maps that do not tile, which these are not."""
        return no_tiling(given)

    @cached_property
    def woven(self) -> Weave:
        """One tile of the weave; an InputError at a key that is invalid or names an unused yarn."""
        text, names = self.weave or "", list(self.yarns)
        draft, blocks = parse_draft(text), colors_of(text)
        if self.warp is not None:
            warp = parse_sequence(self.warp, "warp")
            weft = warp if self.weft is None else parse_sequence(self.weft, "weft")
        elif blocks is not None:
            if len(names) != 2:
                raise InputError(
                    f"{text.strip()} needs two yarns, or 'warp' and 'weft'",
                    where="yarns",
                    hint="such as yarns: {dark: '#20242f', light: '#e8e2d4'}",
                )
            (a, b), (ends, picks) = names, blocks
            warp, weft = [a] * ends + [b] * ends or [a], [a] * picks + [b] * picks or [b]
        elif names:
            raise InputError(
                "are given, but not their sequence", where="yarns", hint=f"such as warp: {names[0]}4"
            )
        else:
            warp = weft = ["yarn"]
        known = names or ["yarn"]
        for key, sequence in (("warp", warp), ("weft", weft)):
            if unknown := next((name for name in sequence if name not in known), None):
                what = f"names the yarn '{unknown}', which 'yarns' does not have"
                hint = suggest_name(unknown, known) or f"it has {', '.join(names) or 'none'}"
                raise InputError(what, where=key, hint=hint)
        if unused := next((name for name in known if name not in (*warp, *weft)), None):
            raise InputError(f"'{unused}' is in neither warp nor weft", where="yarns")
        return Weave.of(draft, warp, weft, self.repeat)
