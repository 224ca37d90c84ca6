"""``mbtf-fit preview``: pictures of a material."""

from __future__ import annotations

from pathlib import Path

from mbtf_core.console import CONSOLE, Console
from mbtf_core.errors import UsageError
from mbtf_core.options import Options, Output, Overwrite, PathText, takes_options
from mbtf_fit.mitsuba_plugin.preview.config import PreviewConfig


@takes_options(PreviewConfig)
def preview(
    material: PathText | None = None,
    /,
    *,
    output: Output = Path("preview"),
    options: Options[PreviewConfig],
    overwrite: Overwrite = False,
    console: Console = CONSOLE,
) -> None:
    """Draw a material: a contact sheet of views, lights and zooms, and a turntable.

    Needs neither a scene nor PyTorch. Writes sheet.png and turntable.gif.

    Parameters
    ----------
    material
        Folder made by mbtf-fit.
    """
    from mbtf_fit.mitsuba_plugin.preview.command import draw

    if material is None and options.config is None:
        raise UsageError("no material given", hint="mbtf-fit preview material/ -o preview/")
    draw(options.resolve(material=material), output, overwrite=overwrite, console=console)
