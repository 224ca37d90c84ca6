"""``mbtf-pipeline report``: the report of a finished run again."""

from __future__ import annotations

from pathlib import Path

from mbtf_core.console import CONSOLE, Console


def report(folder: Path, /, *, console: Console = CONSOLE) -> None:
    """Write the report of a finished run again, or the page and tables of a paper recipe.

    Parameters
    ----------
    folder
        Folder of the run.
    """
    from mbtf_pipeline.paper_tables.suite import is_paper, write_again
    from mbtf_pipeline.run import rerender

    path = write_again(folder) if is_paper(folder) else rerender(folder)
    size = path.stat().st_size
    console.report({"report": path, "bytes": size}, f"{path}: {size / 1e6:.1f} MB")
