"""Several data sets fitted by one command, each a task."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mbtf_core.data.dataset import is_dataset
from mbtf_core.errors import InputError, UsageError, reason
from mbtf_core.paths import refuse_special
from mbtf_core.run.runner import Runner
from mbtf_core.run.task import Item
from mbtf_fit.config import FitConfig


@dataclass(frozen=True)
class FitOutcome:
    """Folders of data and material, and the result (:meth:`FitResult.as_dict`) or the error of the fit."""

    shards: Path
    folder: Path
    result: dict[str, Any] | None
    error: str | None

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {
            "shards": str(self.shards),
            "material": str(self.folder),
            "result": self.result,
            "error": self.error,
        }


def find_data(arguments: Sequence[Path]) -> list[Path]:
    """Data sets of the arguments: a data set's folder, a folder of such folders, or a text file with one
    folder per line, relative to the file; lines that start with # are comments.

    Raises
    ------
    InputError : a list cannot be read, a folder contains no data sets, or one is a pipe or a device
    """
    found: list[Path] = []
    for argument in arguments:
        refuse_special(argument)
        if argument.is_file():
            try:
                lines = [line.strip() for line in argument.read_text(encoding="utf-8").splitlines()]
            except (OSError, UnicodeDecodeError) as error:
                raise InputError(f"cannot be read as a list ({reason(error)})", where=argument) from None
            mine = [argument.parent / line for line in lines if line and not line.startswith("#")]
            for folder in mine:
                refuse_special(folder)
        elif not argument.is_dir() or is_dataset(argument):
            mine = [argument]
        else:
            mine = sorted(path for path in argument.iterdir() if path.is_dir() and is_dataset(path))
        if not mine:
            raise InputError(
                "contains no data sets", where=argument, hint="generate some: mbtf-gen ... -o FOLDER"
            )
        found += mine
    return found


def name_materials(shards: Sequence[Path], out: Path) -> list[Path]:
    """A folder in `out` for each data set, with its name; equal names are prefixed by the parent's name."""
    names = [path.resolve().name for path in shards]
    often = Counter(names)
    parts = [path.resolve().parts[-2:] for path in shards]
    names = [name if often[name] == 1 else "-".join(p) for name, p in zip(names, parts, strict=True)]
    for name, count in Counter(names).items():
        if count > 1:
            raise UsageError(
                f"{count} data sets have the name {name}",
                hint="list each once, rename them, or fit them one by one",
            )
    return [out / name for name in names]


def fit_one(config: FitConfig, shards: Path, folder: Path, overwrite: bool) -> dict[str, Any]:
    """Fit one data set; a task, done when its material is exported.

    Parameters
    ----------
    config : FitConfig
    shards, folder : Path
        Data set and material.
    overwrite : bool
        Replace a fit of another configuration.

    Returns
    -------
    dict
        :meth:`~mbtf_fit.training.fit.FitResult.as_dict`.

    Raises
    ------
    InputError
        The fit cannot use its data.
    PartialError
        The disk is full, or another process writes to the folder.
    """
    from mbtf_fit.training.fit import fit

    return fit(config, shards, folder, overwrite=overwrite).as_dict()


def fit_many(
    configs: Sequence[FitConfig],
    shards: Sequence[Path],
    folders: Sequence[Path],
    runner: Runner,
    *,
    overwrite: bool,
    finished: Callable[[FitOutcome], None],
) -> list[FitOutcome]:
    """Fit every data set with its configuration; outcomes in the order of the data sets.

    A failure does not stop the others. A worker that dies leaves a checkpoint, from which the next one
    resumes.

    Parameters
    ----------
    configs, shards, folders : sequence
        Configuration, data set and material of each fit.
    runner : Runner
        Of other processes: each fit has one of its own, or a worker.
    overwrite : bool
        Replace fits of other configurations.
    finished : callable
        Called with each outcome as it comes.

    Raises
    ------
    PartialError
        The workers cannot be reached any more; finished fits and checkpoints are kept.
    """
    items = [
        Item(
            f"{folder.name}-{i}",
            {"config": config, "shards": data, "folder": folder, "overwrite": overwrite},
            gpu=runner.takes_gpu(config.device),
        )
        for i, (config, data, folder) in enumerate(zip(configs, shards, folders, strict=True))
    ]
    number = {item.name: i for i, item in enumerate(items)}
    outcomes: dict[int, FitOutcome] = {}
    for done in runner.map(fit_one, items, independent=True):
        i = number[done.name]
        outcomes[i] = FitOutcome(shards[i], folders[i], done.value, done.message or None)
        finished(outcomes[i])
    return [outcomes[i] for i in range(len(items))]
