"""Progress of a long job: a bar on terminals, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

from mbtf_core.units import clock

if TYPE_CHECKING:
    from rich.console import RenderableType

# Seconds between two plain progress lines.
_LINE_SECONDS = 10.0
# Letters of the longest label of a part of a job.
_LABEL = 11


class Progress:
    """Progress of one job, made by :meth:`Console.progress`; this class itself shows nothing. `total` is None
    where the number of units is not known."""

    def __init__(self, total: float | None, label: str, unit: str) -> None:
        self.total = total
        self.label = label
        self.unit = unit
        self.done = 0.0
        self.note = ""
        self._start = time.monotonic()
        # Time and units from which the rate counts.
        self._base = (self._start, 0.0)

    @property
    def seconds(self) -> float:
        """Seconds since the job began."""
        return time.monotonic() - self._start

    @property
    def left(self) -> float | None:
        """Seconds left, at the rate since the first units; None where that is not known yet.

        Neither set-up counts, nor what an earlier run has done, nor the first step, which compiles kernels.
        """
        since, before = self._base
        if not self.total or not 0 < before < self.done < self.total:
            return None
        return (self.total - self.done) * (time.monotonic() - since) / (self.done - before)

    def advance(self, step: float = 1, note: str | None = None) -> None:
        """Count `step` more as done."""
        self.update(self.done + step, note)

    def update(
        self, done: float, note: str | None = None, total: float | None = None, label: str | None = None
    ) -> None:
        """Set the units done; `note`, `total` and `label` stay until the next ones. A new label begins
        another part of the job, whose units count from 0."""
        if label is not None and label != self.label:
            self.label, self._base = label, (self._start, 0.0)
        self.done = done
        if not self._base[1]:
            self._base = (time.monotonic(), done)
        if total is not None:
            self.total = total
        if note is not None:
            self.note = note
        self._show()

    def _show(self) -> None:
        """Display the new state."""

    def _close(self) -> None:
        """Display the last state."""


class LineProgress(Progress):
    """Plain lines at intervals, for logs and pipes. While nothing or all is done, each new note has one, as
    has each part of the job."""

    def __init__(self, total: float | None, label: str, unit: str) -> None:
        super().__init__(total, label, unit)
        self._next = self._start + _LINE_SECONDS
        self._shown = ("", 0.0, "")

    def _show(self) -> None:
        outside = not self.done or (self.total is not None and self.done >= self.total)
        is_stage = outside and self.note and self._state != self._shown
        begins = self._shown[0] not in ("", self.label)
        if is_stage or begins or time.monotonic() >= self._next:
            self._next = time.monotonic() + _LINE_SECONDS
            self._print()

    def _close(self) -> None:
        if self.done and self._state != self._shown:
            self._print()

    @property
    def _state(self) -> tuple[str, float, str]:
        return self.label, self.done, self.note

    def _print(self) -> None:
        self._shown = self._state
        parts = [f"{self.label}: {round(self.done, 2):.10g}"]
        if self.unit == "%":
            parts[0] = f"{self.label}: {self.done:.0f}%"
        elif self.total:
            parts[0] += f"/{self.total:.10g} {self.unit}".rstrip() + f" ({self.done / self.total:.0%})"
        elif self.unit:
            parts[0] += f" {self.unit}"
        parts.append(f"{clock(self.seconds)} elapsed")
        if (left := self.left) is not None:
            parts.append(f"{clock(left)} left")
        if self.note:
            parts.append(self.note)
        print(", ".join(parts), file=sys.stderr, flush=True)


class BarProgress(Progress):
    """A bar that redraws itself, for terminals."""

    def __init__(self, total: float | None, label: str, unit: str) -> None:
        super().__init__(total, label, unit)
        from rich import progress
        from rich.console import Console as RichConsole
        from rich.text import Text

        class Rows(progress.Progress):
            """The bar, and the note below it, so that both fit in narrow terminals."""

            def get_renderables(self) -> Iterator[RenderableType]:
                yield from super().get_renderables()
                for task in self.tasks:
                    if task.fields["note"]:
                        yield Text(task.fields["note"], no_wrap=True, overflow="ellipsis")

        console = RichConsole(stderr=True)
        # What the label, the percentage and the two times leave.
        width = min(40, max(4, console.width - max(len(label), _LABEL) - 24))
        self._rich = Rows(
            progress.TextColumn("{task.description}", markup=False),
            progress.BarColumn(width),
            progress.TaskProgressColumn(),
            progress.TimeElapsedColumn(),
            progress.TimeRemainingColumn(),
            console=console,
            # Standard output is for results; rich would redirect it to standard error.
            redirect_stdout=False,
        )
        self._task = self._rich.add_task(label, total=total, note="")
        self._shown = label
        self._rich.start()

    def _show(self) -> None:
        if self.label != self._shown:
            self._rich.reset(self._task, description=self.label)
            self._shown = self.label
        self._rich.update(self._task, completed=self.done, total=self.total, note=self.note)

    def _close(self) -> None:
        self._rich.stop()
