"""Several data sets fitted by one command, each a task."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mbtf_core.data.dataset import is_dataset
from mbtf_core.errors import InputError, UsageError
from mbtf_core.paths import real_path
from mbtf_core.run.runner import Runner
from mbtf_core.run.task import Item
from mbtf_fit.config import FitConfig


def find_data(arguments: Sequence[Path]) -> list[Path]:
    """Data sets of the arguments: a data set's folder, or a folder of such folders.

    Raises
    ------
    InputError : a folder contains no data sets
    """
    found: list[Path] = []
    for argument in arguments:
        mine = [argument]
        if argument.is_dir() and not is_dataset(argument):
            mine = sorted(path for path in argument.iterdir() if path.is_dir() and is_dataset(path))
        if not mine:
            raise InputError(
                "contains no data sets", where=argument, hint="generate some: mbtf-gen ... -o FOLDER"
            )
        found += mine
    return found


def material_folders(shards: Sequence[Path], out: Path) -> list[Path]:
    """A folder in `out` for each data set, with its name; equal names are prefixed by the parent's name."""
    names = [real_path(path).name for path in shards]
    often = Counter(names)
    parts = [real_path(path).parts[-2:] for path in shards]
    names = [name if often[name] == 1 else "-".join(p) for name, p in zip(names, parts, strict=True)]
    for name, count in Counter(names).items():
        if count > 1:
            raise UsageError(
                f"{count} data sets have the name {name}",
                hint="list each once, rename them, or fit them one by one",
            )
    return [out / name for name in names]


def fit_one(config: FitConfig, shards: Path, folder: Path, overwrite: bool) -> dict[str, Any]:
    """Fit one data set; a task, done when its material is exported. Returns
    :meth:`~mbtf_fit.training.fit.FitResult.as_dict`."""
    from mbtf_fit.training.fit import fit

    return fit(config, shards, folder, overwrite=overwrite).as_dict()


def fit_many(
    configs: Sequence[FitConfig],
    shards: Sequence[Path],
    folders: Sequence[Path],
    runner: Runner,
    *,
    overwrite: bool,
    finished: Callable[[Path, str | None], None],
) -> list[dict[str, Any]]:
    """Fit every data set with its configuration; a failure does not stop the others. A worker that dies
    leaves a checkpoint, from which the next one resumes.

    Parameters
    ----------
    configs, shards, folders : configuration, data set and material of each fit
    runner : of other processes: each fit has one of its own, or a worker
    overwrite : replace fits of other configurations
    finished : called with the folder of each fit as it ends, and its error

    Returns
    -------
    list of dict
        In the order of the data sets: ``shards``, ``material``, and ``result`` (of :func:`fit_one`) or
        ``error``.

    Raises
    ------
    PartialError : the workers cannot be reached any more; finished fits and checkpoints are kept
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
    outcomes: dict[int, dict[str, Any]] = {}
    for done in runner.map(fit_one, items, independent=True):
        i, error = number[done.name], done.message or None
        outcomes[i] = {
            "shards": str(shards[i]),
            "material": str(folders[i]),
            "result": done.value,
            "error": error,
        }
        finished(folders[i], error)
    return [outcomes[i] for i in range(len(items))]
