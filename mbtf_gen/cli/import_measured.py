"""``mbtf-gen import``: measured BTFs as data sets."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import DataOutput, Options, Overwrite, PathText, options_from
from mbtf_core.errors import UsageError
from mbtf_core.run.signals import keep_on_interruption
from mbtf_core.units import size_text
from mbtf_gen.cli.generate import describe
from mbtf_gen.config.measured import ImportConfig


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
    """Import a measured BTF as a data set: mbtf-gen import carpet07.btf -o shards/

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
    inside = folder.local is not None and Path(measured).resolve() in (folder.local / "x").resolve().parents
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
    console.report(asdict(summary), describe(summary))
