"""``mbtf-gen preview`` and ``mbtf-gen reference``: pictures of a material."""

from __future__ import annotations

from pathlib import Path

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import ClusterOption, Options, Output, Overwrite, PathText, options_from
from mbtf_gen.cli.generate import resolve_config
from mbtf_gen.config.pictures import RENDERING, PreviewConfig, ReferenceConfig


@options_from(PreviewConfig, "preview", "exposure", *RENDERING)
class PreviewOptions(Options[PreviewConfig]):
    """Options of ``mbtf-gen preview``."""


def preview(
    material: PathText | None = None,
    /,
    *,
    output: Output = Path("preview"),
    options: PreviewOptions = PreviewOptions(),  # noqa: B008
    overwrite: Overwrite = False,
    console: Console = CONSOLE,
) -> None:
    """Draw a path-traced picture of the plane: beauty.png.

    Parameters
    ----------
    material
        Height map, folder of maps, material.yaml, mesh, yarns or fibers.
    """
    resolved = resolve_config(options, material)
    from mbtf_gen.pictures.preview import draw_preview

    draw_preview(resolved, output, console, overwrite=overwrite)


@options_from(ReferenceConfig, "reference", "exposure", *RENDERING)
class ReferenceOptions(Options[ReferenceConfig]):
    """Options of ``mbtf-gen reference``."""


def reference(
    material: PathText | None = None,
    /,
    *,
    output: Output = Path("reference"),
    options: ReferenceOptions = ReferenceOptions(),  # noqa: B008
    cluster: ClusterOption = None,
    overwrite: Overwrite = False,
    console: Console = CONSOLE,
) -> None:
    """Render reference pictures of the micro-geometry.

    It writes EXR with two estimates, and PNG. The same command again renders the missing pictures. All
    pictures have one exposure. Another --exposure renders nothing again.

    Parameters
    ----------
    material
        Height map, folder of maps, material.yaml, mesh, yarns or fibers.
    """
    resolved = resolve_config(options, material)
    from mbtf_gen.pictures.reference import render_references

    render_references(resolved, output, console, cluster=cluster, overwrite=overwrite)
