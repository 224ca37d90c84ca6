"""Options of pages of the viewer, and the page that they describe."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from mbtf_core.app.console import Console
from mbtf_core.app.options import Switch

if TYPE_CHECKING:
    from mbtf_fit.viewer.live import LiveView


@Parameter(name="*", group="Page")
@dataclass(frozen=True)
class PageOptions:
    """What a page shows besides the material.

    Attributes
    ----------
    against : other materials to compare with
    reference : folder of mbtf-gen reference
    shape : a mesh with texture coordinates
    environment : picture of the surroundings
    """

    against: Annotated[
        list[Path] | None, Parameter(help="Another material to compare with in the page. Repeatable.")
    ] = None
    reference: Annotated[
        Path | None, Parameter(help="Folder of mbtf-gen reference to compare with in the page.")
    ] = None
    shape: Annotated[
        Path | None, Parameter(help="Mesh with texture coordinates, as another shape of the page.")
    ] = None
    environment: Annotated[
        Path | None, Parameter(help="Picture of the surroundings (EXR, HDR, PNG), as light in the page.")
    ] = None

    def given(self) -> list[str]:
        """Flags that were given."""
        return [f"--{name}" for name, value in vars(self).items() if value is not None]

    def digests(self) -> dict[str, list[str]]:
        """Digests of the files that the given flags name; of a folder those of its records."""
        from mbtf_core.files.atomic import file_sha256

        out: dict[str, list[str]] = {}
        for name, value in vars(self).items():
            paths = value if isinstance(value, list) else [] if value is None else [value]
            files = [
                file for path in paths for file in (sorted(path.glob("*.json")) if path.is_dir() else [path])
            ]
            if files:
                out[name] = [file_sha256(file) if file.is_file() else "missing" for file in files]
        return out

    def page(self, material: Path) -> tuple[str, str]:
        """HTML of the page, and a line about its precision.

        Raises
        ------
        InputError : a material or another file is at fault
        """
        from mbtf_fit.viewer.content import material_content
        from mbtf_fit.viewer.extras import environment_content, mesh_content, pictures_content
        from mbtf_fit.viewer.page import write_page

        materials = [material_content(folder) for folder in (material, *(self.against or []))]
        content = {
            "materials": [held for held, _ in materials],
            **({} if self.reference is None else {"pictures": pictures_content(self.reference)}),
            **({} if self.shape is None else {"mesh": mesh_content(self.shape)}),
            **({} if self.environment is None else {"environment": environment_content(self.environment)}),
        }
        return write_page(content, materials[0][0]["name"]), materials[0][1]


PAGE_OPTIONS = PageOptions()

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
