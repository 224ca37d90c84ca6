"""Curves of a fit as event files for TensorBoard."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from mbtf_core.errors import UsageError
from mbtf_fit.data.queries import ShardQueries
from mbtf_fit.training.trainer import Trainer
from mbtf_fit.training.validation import errors_by_level


class EventLog:
    """Writes each validation of a fit to a folder, for ``tensorboard --logdir``; a context manager, and an
    :data:`~mbtf_fit.training.fit.Observer`. A resumed fit continues its curves.

    Raises
    ------
    UsageError
        TensorBoard is not installed.
    """

    def __init__(self, folder: Path) -> None:
        try:
            import tensorboard  # noqa: F401
        except ImportError:
            hint = "pip install 'mbtf[tensorboard]', or use --live"
            raise UsageError("TensorBoard is not installed", where="--tensorboard", hint=hint) from None
        self._folder = folder
        self._writer: Any = None

    def __enter__(self) -> EventLog:
        return self

    def __exit__(self, *exception: object) -> None:
        if self._writer is not None:
            self._writer.close()

    def __call__(self, record: dict[str, Any], trainer: Trainer, subset: ShardQueries) -> None:
        """Write a record of :func:`~mbtf_fit.training.validation.read_history`, and the errors by level."""
        step = record["step"]
        if self._writer is None:
            from torch.utils.tensorboard.writer import SummaryWriter

            # A killed run may have written steps after the checkpoint that this one resumes from.
            self._writer = SummaryWriter(str(self._folder), purge_step=step)
        scalars = {
            "loss": record["loss"],
            "unexplained variance": record["unexplained"],
            "queries per second": record["queries_per_second"],
        }
        levels = errors_by_level(trainer, subset) if len(subset) else {}
        scalars |= {f"unexplained variance by level/{level}": value for level, value in levels.items()}
        for name, value in scalars.items():
            if value is not None and math.isfinite(value):
                self._writer.add_scalar(name, value, step)
        self._writer.flush()
