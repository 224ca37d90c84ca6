"""``mbtf-gen publish``: a data set as a folder for data hubs."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import MovedMaterial, Options, Output, Overwrite, Switch, options_from
from mbtf_core.errors import UsageError
from mbtf_core.paths import real_path
from mbtf_core.run.signals import keep_on_interruption
from mbtf_core.units import size_text
from mbtf_gen.config.publish import PublishConfig


@options_from(PublishConfig)
class PublishOptions(Options[PublishConfig]):
    """Options of ``mbtf-gen publish``."""


def publish(
    shards: Path,
    /,
    *,
    output: Output = Path("card"),
    options: PublishOptions = PublishOptions(),  # noqa: B008
    with_maps: Switch = False,
    material: MovedMaterial = None,
    overwrite: Overwrite = False,
    console: Console = CONSOLE,
) -> None:
    """Write a folder to share, with a data card.

    For example: mbtf-gen publish shards/ --license CC-BY-4.0 -o card/

    It holds a data card with a picture, the data, croissant.json, and the recipe that makes the data again.

    Parameters
    ----------
    shards
        Folder of shards, or its URL.
    with_maps
        Publish the input files of the material too, which their license must allow.
    """
    given = [*options.given, *(text.partition("=")[0].strip() for text in options.assignments or ())]
    if options.config is None and "license" not in given:
        raise UsageError(
            "state the license of the published data",
            where="--license",
            hint="an SPDX expression such as CC-BY-4.0; that of the material's maps may restrict it",
        )
    config = options.resolve()
    from mbtf_core.data.folder import DataFolder

    data = DataFolder.open(shards)
    if data.local is not None and real_path(data.local) in (real_path(output), *real_path(output).parents):
        raise UsageError("is the data set, or inside it", where=f"-o {output}", hint="choose another folder")
    from mbtf_gen.publishing.publication import Publication

    publication = Publication.prepare(
        data, config, with_maps=with_maps, material=None if material is None else Path(material)
    )
    console.note(f"{data} -> {output}: {config.form}, at most {size_text(publication.size)}")
    keep_on_interruption(f"the finished files are kept in {output}")
    with console.progress(publication.count, "publishing", "shards") as bar:
        files = publication.write(output, overwrite=overwrite, progress=bar.advance)
    size = sum(stored.bytes for stored in files.values())
    recipe = "no recipe: measured data" if "measured" in publication.data.manifest else "with a recipe"
    console.report(
        {
            "folder": output,
            "name": publication.name,
            "form": config.form,
            "license": config.license,
            "bytes": size,
            "files": {name: asdict(stored) for name, stored in files.items()},
        },
        f"{output}: {publication.name}, {len(files)} files, {size_text(size)}, {recipe}",
    )
