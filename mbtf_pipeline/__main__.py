"""Entry point of ``mbtf-pipeline``."""

from __future__ import annotations

import sys

from mbtf_core.run.signals import finish, handle_signals


def main() -> int:
    """Run the command line; returns the exit code."""
    handle_signals()
    from mbtf_core.app.console import run
    from mbtf_pipeline.cli.app import app

    return finish(run(app))


if __name__ == "__main__":
    sys.exit(main())
