"""Configuration of ``mbtf-fit preview`` and ``mbtf-fit compare``."""

from __future__ import annotations

from typing import Annotated, Any, Self

from pydantic import BeforeValidator, Field, model_validator

from mbtf_core.app.options import Flag
from mbtf_core.color import ALBEDO_EXPOSURE
from mbtf_core.config.settings import Settings
from mbtf_core.units import parse_numbers
from mbtf_gen.config.generator import Paths
from mbtf_gen.config.pictures import (
    EXPOSURE,
    PATHS_PER_PIXEL,
    Direction,
    DirectionsSection,
    Exposure,
    Size,
    TilesAcross,
    ViewSection,
)

# Limits the memory of the sheet to a gigabyte.
MOST_PIXELS = 1 << 25
# Of a comparison: texels across a pixel, and paths per pixel.
_TEXELS = (1, 2, 4)
_SPP, _FIBER_SPP = 256, 64


def _listed(value: Any) -> Any:
    """A single direction as a list of one."""
    return [value] if isinstance(value, str) else value


Directions = Annotated[list[Direction], BeforeValidator(_listed), Field(min_length=1, max_length=8)]
Width = Annotated[float, Field(gt=0, le=1e4)]


class SheetSection(Settings):
    """The contact sheet: a column per view and light, a row per width of the field of view."""

    view: Annotated[Directions, Flag("--view", "ELEVATION,AZIMUTH")] = Field(
        [Direction(elevation=70, azimuth=-90), Direction(elevation=30, azimuth=-90)],
        description="direction of the camera in degrees; default: two views",
    )
    light: Annotated[Directions, Flag("--light", "ELEVATION,AZIMUTH")] = Field(
        [
            Direction(elevation=65, azimuth=60),
            Direction(elevation=35, azimuth=180),
            Direction(elevation=20, azimuth=15),
        ],
        description="direction of the light in degrees; default: three lights",
    )
    tiles_across: Annotated[list[Width], BeforeValidator(parse_numbers), Flag("--tiles-across", "1,2,4")] = (
        Field(
            [1.0, 4.0, 16.0],
            min_length=1,
            max_length=8,
            description="widths of the field of view at the target, in tile widths",
        )
    )
    size: Annotated[int, Flag("--size")] = Field(
        240, ge=64, le=2048, description="pixels along each side of a picture"
    )


class MaterialPreviewConfig(Settings):
    """Every option of ``mbtf-fit preview``."""

    material: str = Field(description="folder made by mbtf-fit")
    sheet: SheetSection = SheetSection()
    exposure: Exposure = Field(ALBEDO_EXPOSURE, description=EXPOSURE)

    @model_validator(mode="after")
    def _fits(self) -> Self:
        sheet = self.sheet
        panels = len(sheet.view) * len(sheet.light) * len(sheet.tiles_across)
        if panels * sheet.size**2 > MOST_PIXELS:
            raise ValueError(f"asks for more than {MOST_PIXELS:,} pixels; use smaller or fewer pictures")
        return self


class ComparisonSection(DirectionsSection):
    """Pictures of the plane, path-traced and of the fit, as coarse as the data."""

    tiles_across: Annotated[TilesAcross | None, Flag("--tiles-across", "1,2,4")] = Field(
        None,
        description="widths of the field of view at the target, in tile widths; default: pixels cover 1, 2 "
        "and 4 texels of the data",
    )
    size: Annotated[Size, Flag("--size")] = Field(128, description="pixels along each side of a picture")
    spp: Annotated[Paths | None, Flag("--spp")] = Field(
        None, description=f"{PATHS_PER_PIXEL}; default: {_SPP}, {_FIBER_SPP} through fibers"
    )

    def resolved(self, resolution: int, fibers: bool) -> ViewSection:
        """The pictures of data with so many texels across, of fibers or not."""
        finest = self.size / resolution
        return ViewSection(
            view=self.view,
            light=self.light,
            tiles_across=self.tiles_across or [finest * texels for texels in _TEXELS],
            size=self.size,
            spp=self.spp or (_FIBER_SPP if fibers else _SPP),
        )


class ComparisonConfig(Settings):
    """Every option of ``mbtf-fit compare``."""

    material: str = Field(description="folder made by mbtf-fit")
    shards: str = Field(description="folder made by mbtf-gen, or its URL")
    picture: ComparisonSection = ComparisonSection()
    exposure: Exposure = Field(ALBEDO_EXPOSURE, description=EXPOSURE)
