"""Entry point of ``mbtf-gen``."""

from __future__ import annotations

import sys


def main() -> int:
    """Run the command line; returns the exit code."""
    from .cli import app
    from .console import run

    return run(app)


if __name__ == "__main__":
    sys.exit(main())
