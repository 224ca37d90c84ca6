"""Options of the commands that make pictures: those of the generator, and what the pictures show."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from mbtf_core.config_file import Settings
from mbtf_gen.config.generator import GeneratorConfig, Paths


def _distinct(values: list[float]) -> list[float]:
    if len(set(values)) < len(values):
        raise ValueError("holds the same width twice")
    return values


class Direction(Settings):
    """A direction above the plane."""

    elevation: float = Field(gt=0, le=90, description="degrees above the plane")
    azimuth: float = Field(ge=-360, le=360, description="degrees from +u towards +v")


Size = Annotated[int, Field(ge=8, le=16384)]


class ReferenceSection(Settings):
    """Reference pictures."""

    view: Direction = Field(Direction(elevation=60, azimuth=-90), description="where the camera stands")
    light: Direction = Field(Direction(elevation=45, azimuth=45), description="where the light comes from")
    tiles_across: Annotated[
        list[Annotated[float, Field(gt=0, le=1e4)]], Field(min_length=1), AfterValidator(_distinct)
    ] = Field([1.0, 2.0, 4.0], description="widths of the field of view at the target, in tile widths")
    size: Size = Field(256, description="pixels along each side")
    spp: Paths = Field(256, description="paths per pixel, both halves together")
    kind: Literal["query", "pixel", "both"] = Field(
        "both", description="query: M at each pixel's footprint; pixel: the truly filtered image"
    )


class PreviewSection(Settings):
    """Pictures for a first look."""

    view: Direction = Field(Direction(elevation=40, azimuth=-90), description="where the camera stands")
    light: Direction = Field(Direction(elevation=35, azimuth=150), description="where the light comes from")
    tiles: Annotated[int, Field(ge=1, le=4)] = Field(
        2, description="tiles along each side of the drawn plane"
    )
    size: Annotated[int, Field(ge=64, le=8192)] = Field(640, description="pixels across")
    spp: Paths = Field(16, description="paths per pixel of the path-traced picture")


class ReferenceConfig(GeneratorConfig):
    """Everything ``mbtf-gen reference`` needs."""

    reference: ReferenceSection = ReferenceSection()


class PreviewConfig(GeneratorConfig):
    """Everything ``mbtf-gen preview`` needs."""

    preview: PreviewSection = PreviewSection()


def without_queries(config: GeneratorConfig) -> dict[str, Any]:
    """The options, as plain data, of pictures that no query is drawn for."""
    return config.model_dump(mode="json", exclude={"queries", "output"})
