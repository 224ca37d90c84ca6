"""``mbtf-fit preview``: pictures of a material."""

from __future__ import annotations

from pathlib import Path

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import Options, Output, Overwrite, PathText, options_from
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
    overwrite: Overwrite = False,
    console: Console = CONSOLE,
) -> None:
    """Draw a contact sheet of a material.

    Needs neither a scene nor PyTorch. Writes sheet.png. --view and --light replace all its views and
    lights.

    Parameters
    ----------
    material
        Folder made by mbtf-fit.
    """
    from mbtf_core.files.folders import owned
    from mbtf_fit.preview.sheet import draw

    if material is None and options.config is None:
        raise UsageError("no material given", hint="mbtf-fit preview material/ -o preview/")
    config = options.resolve(material=material)
    with owned(output):
        draw(config, output, overwrite=overwrite, console=console)
