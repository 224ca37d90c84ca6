"""``mbtf-fit preview`` and ``mbtf-fit compare``: pictures of a material."""

from __future__ import annotations

from pathlib import Path

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import Options, Output, Overwrite, PathText, options_from
from mbtf_core.errors import UsageError
from mbtf_fit.pictures.config import ComparisonConfig, MaterialPreviewConfig


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
    from mbtf_fit.pictures.sheet import draw

    if material is None and options.config is None:
        raise UsageError("no material given", hint="mbtf-fit preview material/ -o preview/")
    config = options.resolve(material=material)
    with owned(output):
        draw(config, output, overwrite=overwrite, console=console)


@options_from(ComparisonConfig)
class ComparisonOptions(Options[ComparisonConfig]):
    """Options of ``mbtf-fit compare``."""


def compare(
    material: PathText | None = None,
    shards: PathText | None = None,
    /,
    *,
    output: Output = Path("comparison"),
    options: ComparisonOptions = ComparisonOptions(),  # noqa: B008
    overwrite: Overwrite = False,
    console: Console = CONSOLE,
) -> None:
    """Show a fit beside the path-traced reference.

    For example: mbtf-fit compare material/ shards/

    Writes comparison.png, with columns for the reference, the fit and its local error, and the references as
    EXR. Prints the errors without the noise of the references.

    Parameters
    ----------
    material
        Folder made by mbtf-fit.
    shards
        Folder made by mbtf-gen, or its URL; the tile that it was made from is path-traced.
    """
    if options.config is None and (material is None or shards is None):
        raise UsageError("name a material and its data set", hint="mbtf-fit compare material/ shards/")
    config = options.resolve(material=material, shards=shards)
    from mbtf_fit.pictures.comparison import compare

    compare(config, output, console, overwrite=overwrite)
