"""Several data sets fitted by one command, in independent processes."""

from __future__ import annotations

import multiprocessing
import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from mbtf_core.errors import InputError, MbtfError, UsageError, reason
from mbtf_core.shard_schema import MANIFEST_NAME
from mbtf_fit.config import FitConfig


@dataclass(frozen=True)
class FitOutcome:
    """Result or error of one data set.

    Attributes
    ----------
    shards, folder : of the data and of the material
    result : see :meth:`FitResult.as_dict`; None where the fit failed
    error : message of the failure
    """

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
    folder per line, relative to the file; lines that start with # are comments."""
    found: list[Path] = []
    for argument in arguments:
        if argument.is_file():
            try:
                lines = [line.strip() for line in argument.read_text(encoding="utf-8").splitlines()]
            except (OSError, UnicodeDecodeError) as error:
                raise InputError(f"cannot be read as a list ({reason(error)})", where=argument) from None
            mine = [argument.parent / line for line in lines if line and not line.startswith("#")]
        elif (argument / MANIFEST_NAME).exists() or not argument.is_dir():
            mine = [argument]
        else:
            mine = sorted(p.parent for p in argument.glob(f"*/{MANIFEST_NAME}"))
        if not mine:
            raise InputError(
                "holds no data sets", where=argument, hint="generate some: mbtf-gen ... -o FOLDER"
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
    try:
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
    config: FitConfig,
    shards: Sequence[Path],
    folders: Sequence[Path],
    *,
    processes: int,
    overwrite: bool = False,
    finished: Callable[[FitOutcome], None] | None = None,
) -> list[FitOutcome]:
    """Fit every data set, at most `processes` at a time; outcomes in the order of the data sets.

    Each fit has its own process, so that a failure does not stop the others. With CUDA each worker uses the
    GPU of its number; on CPUs the workers divide the cores.

    Parameters
    ----------
    finished : called with each outcome
    """
    context = multiprocessing.get_context("spawn")
    waiting = list(range(len(shards)))
    running: dict[int, tuple[int, Any, Connection]] = {}
    outcomes: dict[int, FitOutcome] = {}
    try:
        while waiting or running:
            for worker in sorted({*range(processes)} - {*running}):
                if waiting:
                    k = waiting.pop(0)
                    mine, theirs = context.Pipe(duplex=False)
                    arguments = (config, shards[k], folders[k], overwrite, worker, processes, theirs)
                    process = context.Process(target=_work, args=arguments)
                    process.start()
                    theirs.close()
                    running[worker] = k, process, mine
            wait([pipe for _, _, pipe in running.values()])
            for worker, (k, process, pipe) in list(running.items()):
                if not pipe.poll():
                    continue
                try:
                    result, error = pipe.recv()
                    process.join()
                except EOFError:
                    process.join()
                    result, error = None, f"its process ended with code {process.exitcode}"
                del running[worker]
                outcomes[k] = FitOutcome(shards[k], folders[k], result, error)
                if finished is not None:
                    finished(outcomes[k])
    except KeyboardInterrupt:
        # A terminal sends Ctrl-C to the children too, which write their checkpoints and exit.
        for _, process, _ in running.values():
            process.join()
        raise
    return [outcomes[k] for k in range(len(shards))]
