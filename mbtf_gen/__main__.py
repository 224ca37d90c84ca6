"""Entry point of ``mbtf-gen``."""

from __future__ import annotations

import sys


def main() -> int:
    """Run the command line; returns the exit code."""
    from mbtf_core.console import run
    from mbtf_gen.cli.app import app

    return run(app)


if __name__ == "__main__":
    sys.exit(main())
