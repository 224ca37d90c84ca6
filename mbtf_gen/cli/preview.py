"""``mbtf-gen preview``: pictures of a material and of its queries."""

from __future__ import annotations

from pathlib import Path

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import Options, Output, Overwrite, PathText, Switch, options_from
from mbtf_core.errors import InputError, UsageError
from mbtf_gen.cli.generate import resolve_config
from mbtf_gen.config.pictures import RENDERING, PreviewConfig

_QUERIES = ("train", "resolution", "min_cos", "layout", "patch_size")


@options_from(PreviewConfig, "preview", "exposure", *(f"queries.{key}" for key in _QUERIES), *RENDERING)
class PreviewOptions(Options[PreviewConfig]):
    """Options of ``mbtf-gen preview``."""


def preview(
    material: PathText | None = None,
    /,
    *,
    output: Output = Path("preview"),
    options: PreviewOptions = PreviewOptions(),  # noqa: B008
    interactive: Switch = False,
    overwrite: Overwrite = False,
    console: Console = CONSOLE,
) -> None:
    """Draw the mesh, a path-traced picture, and the queries of a material or of a folder of shards.

    Parameters
    ----------
    material
        Height map, folder of maps, material.yaml, mesh, file of yarns or fibers, or a folder of shards or its
        URL.
    interactive
        Also show the mesh in a window, where the mouse turns it.
    """
    from mbtf_core.data.dataset import Dataset, is_dataset
    from mbtf_core.data.folder import DataFolder
    from mbtf_gen.pictures.preview.drawing import PreviewPictures

    if interactive:
        from mbtf_gen.pictures.preview.mesh import check_display

        check_display()
    dataset = None
    if material is not None and is_dataset(folder := DataFolder.open(material)):
        dataset = Dataset.open(folder)
        given = [options.flags[key] for key in options.given if not key.startswith(("preview.", "exposure"))]
        given += ["--config"] * (options.config is not None) + ["--set"] * bool(options.assignments)
        if given:
            raise UsageError(
                f"{material} holds a data set, whose configuration is fixed",
                where=given[0],
                hint="leave it out, or name the material instead of its shards",
            )
        if dataset.estimates == 1:
            raise InputError(
                "holds measured data, whose surface is unknown",
                where=material,
                hint="fit it, then: mbtf-fit preview MATERIAL",
            )
        resolved = options.resolve(**dataset.manifest["config"])
    else:
        resolved = resolve_config(options, material)
    PreviewPictures(resolved, dataset, console).draw(output, overwrite, interactive)
