"""Where job files and their commands lie."""

from __future__ import annotations

import os
import shlex
from dataclasses import dataclass
from pathlib import Path

from mbtf_core.errors import UsageError
from mbtf_pipeline.emit.steps import from_here


@dataclass(frozen=True)
class Places:
    """Folders as the job files name them; all commands run in the current folder.

    Attributes
    ----------
    folder : Path
        Folder of the job files, as seen from the current one.
    up : str
        The current folder, as seen from that of the job files.
    """

    folder: Path
    up: str

    @classmethod
    def of(cls, folder: Path) -> Places:
        """The places of job files in a folder.

        Parameters
        ----------
        folder : Path

        Returns
        -------
        Places
        """
        up = os.path.relpath(os.path.realpath(os.curdir), os.path.realpath(folder))
        return cls(Path(from_here(folder)), up)

    def shell(self, name: str) -> str:
        """A file of the folder, quoted for a shell in the current folder."""
        return shlex.quote(str(self.folder / name))

    def start(self, script: str) -> str:
        """The command line that runs a script of the folder from the current one."""
        path = self.folder / script
        return shlex.quote(str(path) if len(path.parts) > 1 else f"./{path}")

    @property
    def make(self) -> str:
        """The command line that runs the makefile of the folder from the current one."""
        return f"make -C {shlex.quote(str(self.folder))}"

    @property
    def change(self) -> str:
        """Lines of a script in the folder that go to the current folder."""
        return f'cd -P -- "$(dirname -- "$0")"\ncd -- {shlex.quote(self.up)}'


def check_names(*paths: Path) -> None:
    """Refuse paths that job files cannot name.

    Parameters
    ----------
    paths : Path

    Raises
    ------
    UsageError
        A path contains a control character, such as a line break.
    """
    for path in paths:
        if not str(path).isprintable():
            raise UsageError("job files cannot name it", where=path, hint="rename it")
