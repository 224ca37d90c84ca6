"""``mbtf-pipeline report``: the report of a finished run again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.errors import UsageError
from mbtf_gen.config.pictures import EXPOSURE


def _check_exposure(kind: object, exposure: object) -> None:
    """Refuse what recipes refuse."""
    if isinstance(exposure, float) and not -40 <= exposure <= 40:
        raise ValueError("must be at least -40 and at most 40")


def report(
    folder: Path,
    /,
    *,
    exposure: Annotated[
        float | Literal["auto"] | None,
        Parameter(
            metavar="EV|auto",
            show_default=False,
            validator=_check_exposure,
            help=f"{EXPOSURE[0].upper()}{EXPOSURE[1:]}.",
        ),
    ] = None,
    console: Console = CONSOLE,
) -> None:
    """Write the report of a finished run again, or the page of a paper recipe or a library.

    Parameters
    ----------
    folder
        Folder of the run.
    """
    from mbtf_core.color import describe_exposure
    from mbtf_pipeline.collection.run import is_collection, write_again
    from mbtf_pipeline.run import rerender

    used = None
    if is_collection(folder):
        if exposure is not None:
            raise UsageError("the page of several runs has no exposure", where="--exposure")
        path = write_again(folder)
    else:
        path, used = rerender(folder, exposure)
    size = path.stat().st_size
    text = f"{path}: {size / 1e6:.1f} MB" + ("" if used is None else f", {describe_exposure(used)}")
    console.report({"report": path, "bytes": size, "exposure": used}, text)
