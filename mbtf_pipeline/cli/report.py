"""``mbtf-pipeline report``: the report of a finished run again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.errors import UsageError
from mbtf_gen.config.pictures import EXPOSURE


def report(
    folder: Path,
    /,
    *,
    exposure: Annotated[
        float | Literal["auto"] | None,
        Parameter(
            metavar="EV|auto",
            show_default=False,
            help=f"{EXPOSURE[0].upper()}{EXPOSURE[1:]}.",
        ),
    ] = None,
    console: Console = CONSOLE,
) -> None:
    """Write the report of a finished run again.

    The page of a paper recipe or of a library too.

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
