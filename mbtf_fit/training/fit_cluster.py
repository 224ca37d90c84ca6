"""Fits on the workers of a cluster: a task is a fit, done when its material is exported."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from mbtf_core.cluster.engine import Cluster
from mbtf_core.cluster.task import Task, worker_threads
from mbtf_core.errors import InputError
from mbtf_fit.config import FitConfig
from mbtf_fit.training.fit_many import FitOutcome

_THIS = "mbtf_fit.training.fit_cluster:fit_one"


def fit_on_cluster(
    configs: Sequence[FitConfig],
    shards: Sequence[Path],
    folders: Sequence[Path],
    cluster: Cluster,
    *,
    overwrite: bool,
    finished: Callable[[FitOutcome], None],
) -> list[FitOutcome]:
    """Fit every data set with its configuration on the workers of a cluster; outcomes in the order of the
    data sets.

    A worker that dies leaves a checkpoint, from which the next one resumes. A failure does not stop the
    others. `finished` is called with each outcome.

    Raises
    ------
    PartialError : the cluster is lost; finished fits and checkpoints are kept
    """
    tasks, number = [], {}
    for i, (config, data, folder) in enumerate(zip(configs, shards, folders, strict=True)):
        task = fit_task(f"{folder.name}-{i}", config, data, folder, overwrite)
        tasks.append(task)
        number[task.name] = i
    outcomes: dict[int, FitOutcome] = {}
    for done in cluster.run(tasks, stop_when_fatal=False):
        i = number[done.task.name]
        outcomes[i] = FitOutcome(shards[i], folders[i], done.value, done.error or None)
        finished(outcomes[i])
    return [outcomes[i] for i in range(len(tasks))]


def fit_task(name: str, config: FitConfig, shards: Path, folder: Path, overwrite: bool) -> Task:
    """The task of one fit."""
    arguments = {
        "config": config.model_dump(mode="json"),
        "shards": str(shards),
        "folder": str(folder),
        "working_folder": str(Path.cwd()),
        "overwrite": overwrite,
    }
    return Task(name, _THIS, arguments, gpu=config.device == "cuda")


def fit_one(
    config: dict[str, Any], shards: str, folder: str, working_folder: str, overwrite: bool
) -> dict[str, Any]:
    """Fit one data set; runs on a worker.

    Parameters
    ----------
    config : dict
        Resolved configuration.
    shards, folder : str
        Data set and material.
    working_folder : str
        Folder that all paths are relative to.
    overwrite : bool
        Replace a fit of another configuration.

    Returns
    -------
    dict
        :meth:`~mbtf_fit.training.fit.FitResult.as_dict`.

    Raises
    ------
    InputError
        This machine does not see the working folder, or the fit cannot use its data.
    PartialError
        The disk is full, or another process writes to the folder.
    """
    from mbtf_fit.training.fit import fit

    with in_folder(working_folder):
        return fit(FitConfig.model_validate(config), shards, folder, overwrite=overwrite).as_dict()


@contextlib.contextmanager
def in_folder(working_folder: str) -> Iterator[None]:
    """Work in the folder that paths of a task are relative to, with the worker's threads.

    Raises
    ------
    InputError : this machine does not see the folder
    """
    import torch

    if not Path(working_folder).is_dir():
        raise InputError("this machine does not see the folder", where=working_folder)
    if (threads := worker_threads()) is not None:
        torch.set_num_threads(threads)
    with contextlib.chdir(working_folder):
        yield
