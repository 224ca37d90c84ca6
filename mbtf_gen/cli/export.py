"""``mbtf-gen export``: data sets for the training code of others."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import Overwrite
from mbtf_core.errors import UsageError


def export(
    shards: Path,
    file: Path,
    /,
    *,
    program: Literal["neumip", "neuralbtf"] = "neumip",
    overwrite: Overwrite = False,
    console: Console = CONSOLE,
) -> None:
    """Write the training queries of a data set as HDF5 for other programs.

    Parameters
    ----------
    shards
        Folder of shards, or its URL.
    file
        HDF5 file to write.
    program
        The program that reads it: NeuMIP (shuffled layout) or NeuralBTF (slices layout).
    """
    from mbtf_core.data.dataset import Dataset
    from mbtf_core.data.folder import DataFolder
    from mbtf_gen.measured.exported import export_neumip, export_neural_btf

    folder = DataFolder.open(shards)
    inside = folder.local is not None and folder.local.resolve() in file.resolve().parents
    if file.is_dir() or inside:
        raise UsageError("is a folder, or inside the data set", where=file, hint="choose another name")
    if not file.resolve().parent.is_dir():
        raise UsageError("the folder does not exist", where=file.parent)
    if file.exists() and not overwrite:
        raise UsageError("exists", where=file, hint="choose another name, or --overwrite")
    data = Dataset.open(folder)
    count = (export_neumip if program == "neumip" else export_neural_btf)(data, file)
    total = int(data.manifest["splits"]["train"]["queries"])
    left = f"; {total - count} that do not fill an image are left out" if count < total else ""
    console.report({"file": file, "program": program, "values": count}, f"{file}: {count} values{left}")
