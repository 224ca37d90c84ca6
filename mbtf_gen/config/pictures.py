"""Options of the commands that render pictures: the generator's, and view, light and size."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from mbtf_core.app.options import Flag
from mbtf_core.color import ALBEDO_EXPOSURE
from mbtf_core.config.settings import Settings, distinct
from mbtf_core.meshes.read import MESH_FILES
from mbtf_core.units import parse_numbers
from mbtf_gen.config.generator import GeneratorConfig, Paths


class Direction(Settings):
    """A direction above the plane."""

    elevation: float = Field(gt=0, le=90, description="degrees above the plane")
    azimuth: float = Field(0.0, ge=-360, le=360, description="degrees from +u towards +v")

    @model_validator(mode="before")
    @classmethod
    def _read(cls, value: Any) -> Any:
        """A direction written as ``ELEVATION,AZIMUTH``."""
        if not isinstance(value, str):
            return value
        try:
            elevation, azimuth = (float(part) for part in value.split(","))
        except ValueError:
            raise ValueError("must be ELEVATION,AZIMUTH in degrees, such as 60,-90") from None
        return {"elevation": elevation, "azimuth": azimuth}


Shape = Literal["plane", "sphere", "cylinder", "torus"]


def _surface(value: str) -> str:
    """The name of a shape or of a mesh."""
    if value not in get_args(Shape) and Path(value).suffix.lower() not in MESH_FILES:
        raise ValueError(f"must be {', '.join(get_args(Shape))}, or a mesh: {', '.join(MESH_FILES)}")
    return value


Size = Annotated[int, Field(ge=8, le=16384)]
TilesAcross = Annotated[
    list[Annotated[float, Field(gt=0, le=1e4)]],
    BeforeValidator(parse_numbers),
    Field(min_length=1),
    AfterValidator(distinct),
]
PATHS_PER_PIXEL = "paths per pixel"
Exposure = Annotated[Annotated[float, Field(ge=-40, le=40)] | Literal["auto"], Flag("--exposure", "EV|auto")]
EXPOSURE = (
    "exposure of the pictures: v in 1/sr is shown as 2^EV v. 1.65 shows a white diffuse surface as white; "
    "auto, the 95th percentile of the pictures as 0.8"
)
# Sections of the generator's configuration that decide what a picture shows.
RENDERING = ("geometry", "light", "transport", "effects", "seed")


class DirectionsSection(Settings):
    """One view and light; by default an oblique view and, behind the material, a raking light, which show
    relief, shadows and highlights."""

    view: Annotated[Direction, Flag("--view", "ELEVATION,AZIMUTH")] = Field(
        Direction(elevation=45, azimuth=-90), description="direction of the camera in degrees"
    )
    light: Annotated[Direction, Flag("--light", "ELEVATION,AZIMUTH")] = Field(
        Direction(elevation=25, azimuth=130), description="direction of the light in degrees"
    )


class ViewSection(DirectionsSection):
    """Path-traced pictures of the plane: one view and light, several widths of the field of view."""

    tiles_across: Annotated[TilesAcross, Flag("--tiles-across", "1,2,4")] = Field(
        [1.0, 2.0, 4.0], description="widths of the field of view at the target, in tile widths"
    )
    size: Annotated[Size, Flag("--size")] = Field(256, description="pixels along each side of a picture")
    spp: Annotated[Paths, Flag("--spp")] = Field(256, description=PATHS_PER_PIXEL)


class ReferenceSection(ViewSection):
    """Reference pictures."""

    kind: Annotated[Literal["query", "pixel", "both"], Flag("--kind")] = Field(
        "both", description="values: M at each pixel's footprint (query), or the filtered image (pixel)"
    )
    surface: Annotated[
        Annotated[str, AfterValidator(_surface)], Flag("--surface", "sphere|cylinder|torus|FILE")
    ] = Field("plane", description="what the material covers: a shape, or a mesh with uv")
    tiles: Annotated[Annotated[float, Field(gt=0, le=1000)] | None, Flag("--tiles-per-uv")] = Field(
        None,
        description="tiles around a shape, or per unit of a mesh's uv; default: 13",
    )
    up: Annotated[Literal["y", "z"] | None, Flag("--up")] = Field(
        None, description="upward axis of a mesh; default: y for glTF, else z"
    )

    @model_validator(mode="after")
    def _check_kind(self) -> Self:
        if self.surface != "plane" and self.kind == "query":
            raise ValueError("only a plane has pictures of the kind query")
        if self.surface == "plane" and self.tiles is not None:
            raise ValueError("a plane has no number of tiles: choose a surface, or give tiles_across")
        if self.surface in get_args(Shape) and self.tiles is not None and (self.tiles < 3 or self.tiles % 1):
            raise ValueError("the tiles around a shape must be a whole number of at least 3")
        return self

    def framed(self, radius: float) -> Self:
        """With a field of view around a surface of a radius in tile widths where none is given."""
        if "tiles_across" in self.model_fields_set:
            return self
        return self.model_copy(update={"tiles_across": [float(math.ceil(2.4 * radius))]})


class PreviewSection(Settings):
    """Pictures of ``mbtf-gen preview``."""

    view: Annotated[Direction, Flag("--view", "ELEVATION,AZIMUTH")] = Field(
        Direction(elevation=40, azimuth=-90), description="direction of the camera in degrees"
    )
    light: Annotated[Direction, Flag("--light", "ELEVATION,AZIMUTH")] = Field(
        Direction(elevation=35, azimuth=150), description="direction of the light in degrees"
    )
    tiles: Annotated[int, Field(ge=1, le=4), Flag("--tiles")] = Field(
        2, description="tiles along each side of the drawn plane"
    )
    size: Annotated[Annotated[int, Field(ge=64, le=8192)] | None, Flag("--size")] = Field(
        None, description="pixels along each side of a picture; default: 640, or 320 for fibers"
    )
    spp: Annotated[Paths | None, Flag("--spp")] = Field(
        None, description=f"{PATHS_PER_PIXEL}; default: 16, or 8 for fibers"
    )

    def sizes(self, fibers: bool) -> tuple[int, int]:
        """Size and paths per pixel; by default, no material takes much longer than a minute."""
        size, spp = (320, 8) if fibers else (640, 16)
        return self.size or size, self.spp or spp


class ReferenceConfig(GeneratorConfig):
    """Everything ``mbtf-gen reference`` needs."""

    reference: ReferenceSection = ReferenceSection()
    exposure: Exposure = Field(ALBEDO_EXPOSURE, description=EXPOSURE)


class PreviewConfig(GeneratorConfig):
    """Everything ``mbtf-gen preview`` needs."""

    preview: PreviewSection = PreviewSection()
    exposure: Exposure = Field(ALBEDO_EXPOSURE, description=EXPOSURE)
