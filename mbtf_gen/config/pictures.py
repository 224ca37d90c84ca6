"""Options of the commands that render pictures: the generator's, and view, light and size."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from mbtf_core.config_file import Settings
from mbtf_gen.config.generator import GeneratorConfig, Paths


def _distinct(values: list[float]) -> list[float]:
    if len(set(values)) < len(values):
        raise ValueError("lists the same width twice")
    return values


class Direction(Settings):
    """A direction above the plane."""

    elevation: float = Field(gt=0, le=90, description="degrees above the plane")
    azimuth: float = Field(ge=-360, le=360, description="degrees from +u towards +v")


Size = Annotated[int, Field(ge=8, le=16384)]


class ReferenceSection(Settings):
    """Reference pictures."""

    view: Direction = Field(Direction(elevation=60, azimuth=-90), description="direction towards the camera")
    light: Direction = Field(Direction(elevation=45, azimuth=45), description="direction towards the light")
    tiles_across: Annotated[
        list[Annotated[float, Field(gt=0, le=1e4)]], Field(min_length=1), AfterValidator(_distinct)
    ] = Field([1.0, 2.0, 4.0], description="tiles across the picture, at the target")
    size: Size = Field(256, description="pixels along each side")
    spp: Paths = Field(256, description="paths per pixel, both halves together")
    kind: Literal["query", "pixel", "both"] = Field(
        "both", description="query: M at each pixel's footprint; pixel: the filtered image"
    )


class PreviewSection(Settings):
    """Pictures of ``mbtf-gen preview``."""

    view: Direction = Field(Direction(elevation=40, azimuth=-90), description="direction towards the camera")
    light: Direction = Field(Direction(elevation=35, azimuth=150), description="direction towards the light")
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
    """The options, as plain data, without those of queries and output."""
    return config.model_dump(mode="json", exclude={"queries", "output"})
