"""Help pages: ``--help`` describes what most people need and names the rest; ``--help-all`` describes all."""

from __future__ import annotations

from typing import Any

from cyclopts import Group
from cyclopts.help import DefaultFormatter, HelpPanel

HELP_ALL = "--help-all"
# Whether the running command line asks for the whole page.
_whole = False


def show_whole_page(whole: bool) -> None:
    """Choose what the next help page describes: all options, or those that most people need."""
    global _whole
    _whole = whole


def _format_more(console: Any, options: Any, panel: HelpPanel) -> None:
    """Options of the group MORE: a panel on the whole page, their names on the short one."""
    if _whole:
        DefaultFormatter()(console, options, panel)
    elif panel.entries:
        names = ", ".join(entry.names[0] for entry in panel.entries)
        console.print(f"{HELP_ALL} describes more options: {names}", markup=False, highlight=False)


# Options that few people need; shown last.
MORE = Group("More options", sort_key=1, help_formatter=_format_more)
