"""``mbtf-gen import`` and ``publish``: data sets from others and for others."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import (
    DataOutput,
    MovedMaterial,
    Options,
    Output,
    Overwrite,
    PathText,
    Switch,
    options_from,
)
from mbtf_core.errors import UsageError
from mbtf_core.paths import real_path
from mbtf_core.run.signals import keep_on_interruption
from mbtf_core.units import size_text
from mbtf_gen.cli.generate import describe
from mbtf_gen.config.exchange import ImportConfig, PublishConfig


@options_from(ImportConfig)
class ImportOptions(Options[ImportConfig]):
    """Options of ``mbtf-gen import``."""


def import_measured(
    measured: PathText,
    /,
    *,
    output: DataOutput = Path("shards"),
    options: ImportOptions = ImportOptions(),  # noqa: B008
    overwrite: Overwrite = False,
    console: Console = CONSOLE,
) -> None:
    """Import a measured BTF as a data set.

    For example: mbtf-gen import carpet07.btf -o shards/

    The same command again resumes an unfinished import.

    Parameters
    ----------
    measured
        File of a BTF (.btf, .hdf5), or folder or zip archive of images.
    """
    from mbtf_core.data.folder import DataFolder
    from mbtf_core.files.folders import check_space
    from mbtf_gen.generation.imported import MEASURED_BYTES, Import
    from mbtf_gen.generation.imported import import_measured as run

    folder = DataFolder.open(output)
    inside = folder.local is not None and real_path(measured) in real_path(folder.local / "x").parents
    if Path(measured).is_dir() and inside:
        raise UsageError("is inside the measured folder", where=f"-o {output}", hint="choose another folder")
    job = Import.prepare(Path(measured), options.resolve())
    total = job.count("train") + job.count("test")
    size = total * MEASURED_BYTES
    console.note(
        f"{measured} ({job.format}) -> {folder}: {job.count('train')} training + "
        f"{job.count('test')} test queries, {size_text(size)}"
    )
    for note in job.notes:
        console.note(note)
    if folder.local is not None:
        check_space(folder.local, size, "reduce --queries, or choose another folder with -o")
    keep_on_interruption(f"the shards that are finished are kept in {folder}")
    with console.progress(total=total, label="importing", unit="queries") as bar:
        summary = run(job, folder, overwrite=overwrite, progress=bar.update)
    if job.negative:
        console.note(f"warning: {job.negative} of the queries have negative values, which are kept")
    console.report(asdict(summary), describe(summary))


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
    from mbtf_gen.publishing.recipe import is_yaml_alone

    publication = Publication.prepare(
        data, config, with_maps=with_maps, material=None if material is None else Path(material)
    )
    if is_yaml_alone(publication.data) and not publication.maps:
        console.note(
            "the YAML of the material has moved or changed and is left out; to add it: --with-maps --material"
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
