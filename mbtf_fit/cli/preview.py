"""``mbtf-fit preview``: pictures of a material."""

from __future__ import annotations

from pathlib import Path

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import Options, Output, Overwrite, PathText, Switch, options_from
from mbtf_core.errors import UsageError
from mbtf_fit.preview.config import MaterialPreviewConfig


@options_from(MaterialPreviewConfig)
class MaterialPreviewOptions(Options[MaterialPreviewConfig]):
    """Options of ``mbtf-fit preview``."""


def preview(
    material: PathText | None = None,
    /,
    *,
    output: Output = Path("preview"),
    options: MaterialPreviewOptions = MaterialPreviewOptions(),  # noqa: B008
    sheet_only: Switch = False,
    overwrite: Overwrite = False,
    console: Console = CONSOLE,
) -> None:
    """Draw a contact sheet and a turntable of a material.

    Needs neither a scene nor PyTorch. Writes sheet.png and turntable.gif. --view and --light replace all
    views and lights of the sheet. Sheet and turntable have one exposure.

    Parameters
    ----------
    material
        Folder made by mbtf-fit.
    sheet_only
        Draw no turntable.
    """
    from mbtf_core.files.folders import owned
    from mbtf_fit.preview.sheet import draw

    if material is None and options.config is None:
        raise UsageError("no material given", hint="mbtf-fit preview material/ -o preview/")
    config = options.resolve(material=material)
    with owned(output):
        draw(config, output, sheet_only=sheet_only, overwrite=overwrite, console=console)
