"""What several commands share: options of the configuration, and angles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from cyclopts import Parameter

from mbtf_core.errors import UsageError
from mbtf_core.shard_schema import Tiling
from mbtf_gen.config.presets import Quality

if TYPE_CHECKING:
    from mbtf_gen.config.generator import GeneratorConfig

    C = TypeVar("C", bound=GeneratorConfig)

Set = Annotated[
    list[str], Parameter(name="--set", help="Set any option of the configuration, a.b=c. Repeatable.")
]
Output = Annotated[Path | None, Parameter(name=["--output", "-o"])]
QualityOption = Annotated[
    Quality,
    Parameter(help="Numbers of queries and paths that belong together; other options change single ones."),
]

Flags = Mapping[str, tuple[str, Any]]


def general(
    *,
    height_scale: float | None,
    mesh: int | None,
    light_width: float | None,
    max_depth: int | None,
    seed: int | None,
    make_tileable: Tiling | None = None,
) -> Flags:
    """The flags that several commands have: flag → (dotted key it sets, its value or None)."""
    return {
        "--height-scale": ("geometry.height_scale", height_scale),
        "--mesh": ("geometry.mesh", mesh),
        "--make-tileable": ("geometry.make_tileable", make_tileable),
        "--light-width": ("light.width", light_width),
        "--max-depth": ("transport.max_depth", max_depth),
        "--seed": ("seed", seed),
    }


def resolve_config(
    model: type[C],
    material: str | None,
    config: Path | None,
    assignments: Sequence[str],
    flags: Flags,
) -> C:
    """Configuration of a command.

    Parameters
    ----------
    flags : flag → (dotted key it sets, value or None where it was not given)

    Raises
    ------
    UsageError : no material, or a flag or an assignment is at fault
    InputError : the file is at fault
    """
    from mbtf_core.config_file import resolve

    if material is None and config is None:
        raise UsageError("no material given", hint="mbtf-gen heightfield.exr --queries 400/texel -o shards/")
    resolved = resolve(
        model,
        file=config,
        assignments=assignments,
        flags={"material": material, **dict(flags.values())},
        spelled={key: flag for flag, (key, _) in flags.items()},
    )
    if material is None and config is not None and not Path(resolved.material).is_absolute():
        # A path in a file is relative to that file, so that the file works from anywhere.
        resolved = resolved.model_copy(update={"material": str(config.parent / resolved.material)})
    return resolved


def angles(text: str | None, flag: str) -> dict[str, float] | None:
    """Elevation and azimuth in degrees of an ``ELEVATION,AZIMUTH``.

    Raises
    ------
    UsageError : not of that form, or not above the plane
    """
    if text is None:
        return None
    try:
        elevation, azimuth = (float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(
            f"'{text}' must be ELEVATION,AZIMUTH in degrees, such as 60,-90", where=flag
        ) from None
    if not 0 < elevation <= 90:
        raise UsageError(f"elevation {elevation:g} must lie above 0 and at most at 90 degrees", where=flag)
    return {"elevation": elevation, "azimuth": azimuth}


def numbers(text: str | None, flag: str) -> list[float] | None:
    """Numbers of a list such as ``1,2,4``.

    Raises
    ------
    UsageError : not of that form
    """
    if text is None:
        return None
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise UsageError(f"'{text}' must be numbers separated by commas, such as 1,2,4", where=flag) from None
