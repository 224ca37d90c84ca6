"""Configuration of the generator: every option, typed, with its unit and its default.

The hash of a configuration covers what changes the data (the contents of input files, not their names) and
leaves out what does not (launch size, progress).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from mbtf_core.app.options import Flag, Quality
from mbtf_core.config.settings import FileName, Settings
from mbtf_core.data.lattice import MAX_LEVEL
from mbtf_core.data.schema import SCHEMA_VERSION, ArrayFormat, Layout, SliceDirections, Tiling
from mbtf_core.errors import UsageError
from mbtf_core.files.atomic import data_sha256
from mbtf_core.images.limits import MAX_PIXELS
from mbtf_gen.sampling.light_kernel import MAX_WIDTH_DEG, MIN_WIDTH_DEG

# Largest height scale.
MAX_SCALE = 100
_PERCENT = re.compile(r"^\s*(-?(?:\d+(?:\.\d*)?|\.\d+))\s*%\s*$")
_COUNT = re.compile(r"^\s*(-?\d+(?:\.\d+)?(?:[eE][+]?\d+)?)\s*(/\s*texel)?\s*$")


def parse_count(text: str | int | float) -> tuple[float, bool]:
    """Read ``N`` or ``N/texel``: (N, whether it is per texel).

    Raises
    ------
    ValueError : neither of the two, or not positive
    """
    match = _COUNT.match(str(text))
    if match is None:
        raise ValueError("must be N or N/texel, such as 100000 or 400/texel")
    number = float(match[1])
    if not 0 < number < 1e13:
        raise ValueError("must be positive and below 1e13")
    if match[2] is None and number != int(number):
        raise ValueError("must be a whole number, or N/texel")
    return number, match[2] is not None


def count_queries(text: str | int | float, texels: int) -> int:
    """Number of queries of ``N`` or ``N/texel``; at least 1."""
    number, per_texel = parse_count(text)
    return max(1, round(number * texels) if per_texel else int(number))


def _count(text: Any) -> str:
    """Canonical spelling of a count: ``400 / texel`` and ``400/texel`` are the same configuration."""
    number, per_texel = parse_count(text)
    digits = str(int(number)) if number == int(number) else repr(number)
    return f"{digits}/texel" if per_texel else digits


def _share(text: Any) -> Any:
    """A fraction as a number, also from ``2%``."""
    if isinstance(text, str) and (match := _PERCENT.match(text)):
        return float(match[1]) / 100.0
    return text


def _even(spp: int) -> int:
    if spp % 2:
        raise ValueError("must be even: the paths of a query are divided between two independent estimates")
    return spp


def _light_width(width: float) -> float:
    if 0 < width < MIN_WIDTH_DEG:
        raise ValueError(f"must be 0 (a delta light) or at least {MIN_WIDTH_DEG} degrees")
    return width


def _power_of_two(resolution: int) -> int:
    if not 1 <= resolution <= 1 << MAX_LEVEL or resolution.bit_count() != 1:
        raise ValueError(f"must be a power of two from 1 to {1 << MAX_LEVEL}")
    return resolution


def _gray(value: Any) -> Any:
    if isinstance(value, str):
        raise ValueError("must be one number or three")
    return (value, value, value) if isinstance(value, int | float) and not isinstance(value, bool) else value


Share = Annotated[float, Field(ge=0, le=1)]
Positive = Annotated[float, Field(gt=0, le=1e6)]
# A linear color: three numbers, or one for gray.
Rgb = Annotated[tuple[Share, Share, Share], BeforeValidator(_gray)]

# How rays find a height field: cell by cell, or as triangles by Mitsuba.
Tracer = Literal["heightfield", "mesh"]
# How a normal map and the slopes of the mesh add up.
NormalMode = Literal["residual", "absolute", "off"]

Count = Annotated[str, BeforeValidator(_count)]
Resolution = Annotated[int, AfterValidator(_power_of_two)]
Seed = Annotated[
    int, Field(ge=0, lt=1 << 63, description="root seed of all random numbers"), Flag("--seed", rare=True)
]
TestCount = Annotated[
    Count,
    Field(description="test queries, in total or per texel of the finest level"),
    Flag("--test-queries", "N|N/texel", rare=True),
]
MinCos = Annotated[
    float,
    Field(gt=0, lt=1, description="smallest cosine of light and view directions to the normal"),
    Flag("--min-cos", rare=True),
]
Paths = Annotated[int, Field(ge=2, le=1 << 20), AfterValidator(_even)]


def no_tiling(given: Tiling | None) -> Tiling:
    """``none``: only maps are made tileable.

    Raises
    ------
    UsageError : a method for maps is given
    """
    if given not in (None, "none"):
        raise UsageError("is for height maps, not for fibers and triangles", where="--make-tileable")
    return "none"


class GeometrySection(Settings):
    """The displaced tile."""

    height_scale: Annotated[float | None, Flag("--height-scale")] = Field(
        None,
        ge=-MAX_SCALE,
        le=MAX_SCALE,
        description="factor on the stored heights, in tile widths; default: the material's own",
    )
    max_displacement: float = Field(
        100.0, gt=0, le=1e6, description="largest accepted displacement range, in tile widths"
    )
    max_pixels: int = Field(
        MAX_PIXELS,
        ge=1,
        le=1 << 31,
        description="largest map in pixels; each takes about 30 bytes of memory, 60 for 8-bit heights",
    )
    mesh: Annotated[int | None, Flag("--mesh", rare=True)] = Field(
        None, ge=1, le=8192, description="mesh cells across the tile; default: the map's width, at most 512"
    )
    tracer: Annotated[Tracer, Flag("--tracer", rare=True)] = Field(
        "heightfield",
        description="how rays find the surface: cell by cell, or by Mitsuba as triangles",
    )
    make_tileable: Annotated[Tiling | None, Flag("--make-tileable", rare=True)] = Field(
        None,
        description="method for maps that do not tile: 2 x 2 mirrored copies, or blended edges; "
        "default: the material's own, else none",
    )


class MixtureSection(Settings):
    """Mixture over the fractional level l, weights that are normalized to sum 1."""

    log_uniform: float = Field(0.6, ge=0, description="l uniform in [0, k]")
    finest: float = Field(0.4, ge=0, description="l uniform in [k-1, k]")


class QueriesSection(Settings):
    """Distribution and number of the queries, and paths per query."""

    train: Annotated[Count, Flag("--queries", "N|N/texel")] = Field(
        "100/texel", description="training queries, in total or per texel of the finest level"
    )
    test: TestCount = "8192"
    spp: Annotated[Paths, Flag("--spp")] = Field(
        4, description="mean number of paths per training query, both estimates together (even)"
    )
    test_spp: Annotated[Paths, Flag("--test-spp", rare=True)] = Field(
        256, description="mean number of paths per test query, both estimates together (even)"
    )
    test_highlights: Annotated[
        float | None, BeforeValidator(_share), Flag("--test-highlights", "75%", rare=True)
    ] = Field(
        None,
        ge=0,
        le=0.95,
        description="share of test queries drawn by the highlights, and weighted; default: 75% if a pilot "
        "shows that it pays, else 0",
    )
    lights_per_path: Annotated[int, Flag("--lights-per-path", rare=True)] = Field(
        1,
        ge=1,
        le=64,
        description="training queries that share their paths, each under a light of its own; shuffled layout",
    )
    allocation: Literal["noise", "uniform"] = Field(
        "noise",
        description="paths per query: more where a pilot (2.6 million paths) expects noise, or equal",
    )
    target_error: Annotated[
        float | None, BeforeValidator(_share), Flag("--target-error", "2%", rare=True)
    ] = Field(
        None,
        gt=0,
        lt=1,
        description="error of every training value relative to max(value, tile mean), in place of a mean "
        "number of paths",
    )
    max_spp: Paths = Field(1024, description="most paths per query under a target error")
    resolution: Annotated[Resolution | None, Flag("--resolution")] = Field(
        None,
        description="texels across at the finest level, a power of two; default: the material's own, else "
        "from the map's width",
    )
    mixture: MixtureSection = MixtureSection()
    min_cos: MinCos = 0.1
    layout: Annotated[Layout, Flag("--layout", rare=True)] = Field(
        "shuffled",
        description="shuffled queries, images of one light, view and footprint each, or slices: all finest "
        "texels at the same lights and views",
    )
    slice_directions: SliceDirections = Field(
        "spiral",
        description="slices layout: spirals of n lights and n views for n² queries per texel, or the 81 "
        "directions of Bonn 2003 (6561/texel)",
    )
    patch_size: Annotated[int | None, Flag("--patch-size", rare=True)] = Field(
        None,
        ge=1,
        le=256,
        description="image layout: texels along each side of an image, at the level of its footprint; "
        "default: all texels of the finest level",
    )

    @property
    def finest(self) -> int | None:
        """The finest level k, ``log2(resolution)``; None: the material's own."""
        return None if self.resolution is None else self.resolution.bit_length() - 1


class LightSection(Settings):
    """The smoothed directional light."""

    width: Annotated[float, AfterValidator(_light_width), Flag("--light-width", rare=True)] = Field(
        1.0, ge=0, le=MAX_WIDTH_DEG, description="RMS angle of the light per axis in degrees; 0: delta light"
    )


class TransportSection(Settings):
    """Depth limits of light paths."""

    max_depth: Annotated[int, Flag("--max-depth", rare=True)] = Field(
        0, ge=0, le=1000, description="surface interactions per path; 0: no limit (Russian roulette)"
    )
    roulette_depth: int = Field(1, ge=1, le=1000, description="interactions before Russian roulette begins")
    max_crossings: int = Field(4096, ge=1, description="tile borders that one ray may cross")


class EffectsSection(Settings):
    """Which light transport effects are simulated."""

    mode: Annotated[str, Flag("--effects")] = Field(
        "auto",
        description="simulated effects of light: auto, all or none, then +x or -x for single effects, "
        "comma-separated",
    )
    tolerance: float = Field(
        0.005,
        ge=0,
        lt=1,
        description="allowed bias of all omitted effects together, relative to the mean value",
    )
    normal: NormalMode = Field(
        "residual",
        description="normal map: add the slopes that the mesh lacks, replace the mesh's slopes, or ignore",
    )


class OutputSection(Settings):
    """File format and size of the shards."""

    format: Annotated[ArrayFormat, Flag("--format", rare=True)] = Field(
        "npz", description="file format of the shards"
    )
    shard_queries: int = Field(1 << 18, ge=1, le=1 << 24, description="queries per shard")


class GeneratorConfig(Settings):
    """Everything that ``mbtf-gen`` needs to generate a data set."""

    exclusive = (("queries.spp", "queries.target_error"),)

    version: Literal[2] = 2
    material: FileName = Field(description="height map, folder of maps, or material.yaml")
    geometry: GeometrySection = GeometrySection()
    queries: QueriesSection = QueriesSection()
    light: LightSection = LightSection()
    transport: TransportSection = TransportSection()
    effects: EffectsSection = EffectsSection()
    output: OutputSection = OutputSection()
    seed: Seed = 0

    def hash(self, inputs: dict[str, str]) -> str:
        """SHA-256 of everything that determines the data: options, and digests of the input files by role."""
        # The limits do not change the data.
        fields = self.model_dump(exclude={"material": True, "geometry": {"max_displacement", "max_pixels"}})
        return data_sha256({"schema": SCHEMA_VERSION, "inputs": inputs, **fields})


def _queries(train: str, spp: int, test: str, test_spp: int) -> dict[str, Any]:
    return {"queries.train": train, "queries.spp": spp, "queries.test": test, "queries.test_spp": test_spp}


RESOLUTION = "queries.resolution"
# Options of the generator by quality preset, dotted names, from a quick draft to the sizes of the papers. A
# preset overrides the configuration file; ``--set`` and flags override the preset. ``benchmarks/quality.py``
# measures the time that each takes and the error that it reaches. Explicit resolutions and maps of lower
# resolution override the resolution of a preset; `paper` uses the map's.
GENERATOR: dict[Quality, dict[str, Any]] = {
    # As many paths in twice the queries leave up to a tenth more error on glossy materials and take twice the
    # disk; half the queries leave more, too. Test errors are free of noise and limited by their variance over
    # queries, so many test queries get few paths each.
    "draft": {RESOLUTION: 128, **_queries("200/texel", 8, "65536", 16)},
    "standard": {RESOLUTION: 256, **_queries("800/texel", 4, "131072", 32)},
    "high": {RESOLUTION: 512, **_queries("1600/texel", 4, "262144", 128)},
    # Kuznetsov et al. 2021: 200 to 400 queries per texel of 64 paths.
    "paper": _queries("400/texel", 64, "262144", 256),
}


def generator_options(quality: Quality | None, given: Mapping[str, Any]) -> dict[str, Any]:
    """Options of the generator at a quality preset, dotted names; none without a preset.

    Parameters
    ----------
    given : explicit options of file and command line, nested; their resolution overrides the preset's
    """
    queries = given.get("queries")
    explicit = isinstance(queries, Mapping) and queries.get("resolution") is not None
    options = {} if quality is None else GENERATOR[quality]
    return {name: value for name, value in options.items() if not (explicit and name == RESOLUTION)}
