"""What several commands share: options of the configuration, and angles."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from ..errors import UsageError

Set = Annotated[
    list[str], Parameter(name="--set", help="Set any option of the configuration, a.b=c. Repeatable.")
]
Output = Annotated[Path | None, Parameter(name=["--output", "-o"])]


def resolve_config(
    material: str | None, config: Path | None, assignments: list[str], flags: dict[str, Any]
) -> Any:
    from ..config import GeneratorConfig, check_queries_flag
    from ..settings import resolve

    check_queries_flag(flags.get("queries.train"), "--queries")
    check_queries_flag(flags.get("queries.test"), "--test-queries")
    if material is None and config is None:
        raise UsageError("no material given", cure="mbtf-gen heightfield.exr --queries 400/texel -o shards/")
    resolved = resolve(
        GeneratorConfig, file=config, assignments=assignments, flags={"material": material, **flags}
    )
    if material is None and config is not None and not Path(resolved.material).is_absolute():
        # A path in a file is relative to that file, so that the file works from anywhere.
        resolved = resolved.model_copy(update={"material": str(config.parent / resolved.material)})
    return resolved


def angles(text: str, flag: str) -> tuple[float, float]:
    parts = text.split(",")
    try:
        elevation, azimuth = (float(p) for p in parts)
    except ValueError:
        raise UsageError(
            f"'{text}' must be ELEVATION,AZIMUTH in degrees, such as 60,-90", where=flag
        ) from None
    if not 0 < elevation <= 90:
        raise UsageError(f"elevation {elevation:g} must lie above 0 and at most at 90 degrees", where=flag)
    return elevation, azimuth
