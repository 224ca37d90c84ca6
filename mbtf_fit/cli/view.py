"""``mbtf-fit view``: a material in the browser."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import whole_number
from mbtf_core.run.signals import served_until_interruption
from mbtf_fit.export.web import PageOptions, make_page


def view(
    material: Path,
    /,
    *,
    page: PageOptions = PageOptions(),  # noqa: B008
    port: Annotated[int, Parameter(converter=whole_number)] = 0,
    console: Console = CONSOLE,
) -> None:
    """Show a material in the browser.

    For example: mbtf-fit view material/

    Turn it under lights with the mouse, zoom, and compare it with other materials or with reference
    pictures. The page is served on this machine alone until Ctrl-C. For a file, see mbtf-fit export --to
    web.

    Parameters
    ----------
    material
        Folder made by mbtf-fit.
    port
        Port of the page; 0 takes a free one.
    """
    from mbtf_fit.viewer.server import PageServer

    html, precision = make_page(material, page)
    server = PageServer(html, port)
    console.note(precision)
    with served_until_interruption():
        console.report({"url": server.url}, f"{server.url}\nopen it in a browser; Ctrl-C ends")
        # A script that reads the address waits for it.
        sys.stdout.flush()
    server.close()
