"""Option ``--live``: a page that shows the progress of a command."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from mbtf_core.app.console import Console
from mbtf_core.app.options import Switch

if TYPE_CHECKING:
    from mbtf_fit.viewer.live import LiveView

Live = Annotated[Switch, Parameter(help="Show the progress in the browser while the command runs.")]


@contextmanager
def live_view(title: str, wanted: bool, console: Console) -> Iterator[LiveView | None]:
    """A page that shows the progress of a command until it ends; None where it is not wanted."""
    if not wanted:
        yield None
        return
    from mbtf_fit.viewer.live import LiveView

    live = LiveView(title)
    console.note(f"open in a browser: {live.url}")
    try:
        yield live
    finally:
        live.close()
