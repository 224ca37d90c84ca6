"""Several data sets fitted by one command, in independent processes."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from mbtf_core.cluster.children import answer_of_child, kill_children, prepare_child
from mbtf_core.data.dataset import is_dataset
from mbtf_core.errors import InputError, MbtfError, UsageError, reason
from mbtf_core.interruption import SIGNALS, at_end
from mbtf_core.suggest import refuse_special
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


def _work(
    config: FitConfig, shards: Path, out: Path, overwrite: bool, worker: int, processes: int, pipe: Connection
) -> None:
    """One fit, in its own process; sends its result or its error."""
    # Selects the GPU of the process, so it precedes the import of CUDA.
    if config.device != "cpu":
        visible = os.environ.get("CUDA_VISIBLE_DEVICES")
        devices = visible.split(",") if visible else []
        os.environ["CUDA_VISIBLE_DEVICES"] = devices[worker % len(devices)] if devices else str(worker)
    prepare_child()
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
        import torch

        from mbtf_fit.training.fit import fit

        if processes > 1:
            torch.set_num_threads(max(1, torch.get_num_threads() // processes))
        pipe.send((fit(config, shards, out, overwrite=overwrite).as_dict(), None))
    except MbtfError as error:
        pipe.send((None, error.message))
    except KeyboardInterrupt:
        pipe.send((None, "interrupted; the same command resumes"))
    except Exception as error:
        pipe.send((None, f"internal error: {type(error).__name__}: {reason(error)}"))


def fit_many(
    configs: Sequence[FitConfig],
    shards: Sequence[Path],
    folders: Sequence[Path],
    *,
    processes: int,
    overwrite: bool,
    finished: Callable[[FitOutcome], None],
) -> list[FitOutcome]:
    """Fit every data set with its configuration, at most `processes` at a time; outcomes in the order of the
    data sets.

    Each fit has its own process, so that a failure does not stop the others. With CUDA each worker uses the
    GPU of its number; on CPUs the workers divide the cores. `finished` is called with each outcome.
    """
    at_end(kill_children)
    free: SimpleQueue[int] = SimpleQueue()
    for worker in range(processes):
        free.put(worker)

    def run(config: FitConfig, data: Path, folder: Path) -> FitOutcome:
        worker = free.get()
        try:
            result, error = answer_of_child(_work, config, data, folder, overwrite, worker, processes)
        except ChildProcessError as ended:
            result, error = None, str(ended)
        finally:
            free.put(worker)
        return FitOutcome(data, folder, result, error)

    with ThreadPoolExecutor(processes) as pool:
        fits = [pool.submit(run, *pair) for pair in zip(configs, shards, folders, strict=True)]
        try:
            for outcome in as_completed(fits):
                finished(outcome.result())
        except KeyboardInterrupt:
            # The children write their checkpoints and exit.
            for child in multiprocessing.active_children():
                child.terminate()
            pool.shutdown(cancel_futures=True)
            raise
    return [fit.result() for fit in fits]
