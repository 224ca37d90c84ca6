"""Opens the runner that ``--cluster`` names."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from mbtf_core.run.runner import Runner


@contextlib.contextmanager
def open_runner(
    where: str | None, note: Callable[[str], None], otherwise: Runner | None = None
) -> Iterator[Runner]:
    """A runner for the tasks of a block.

    Parameters
    ----------
    where : ``local``, ``local:4``, a YAML file of :class:`~mbtf_core.run.workers.ClusterConfig`, or the
        address of a scheduler; None for `otherwise`
    note : receives lines for the user
    otherwise : this process by default

    Raises
    ------
    UsageError : Dask is not installed, or `where` is none of these
    InputError : the batch system or the scheduler cannot be used
    """
    if where is None:
        yield otherwise or Runner()
        return
    from mbtf_core.run.dask_runner import open_workers

    with open_workers(where, note) as workers:
        yield workers
