"""A page that shows a material in a browser, without a network."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mbtf_core.files.editable import write_document
from mbtf_fit.export import Export, ExportTarget, flags

PAGE_NAME = "viewer.html"


@flags("Page")
@dataclass(frozen=True)
class PageOptions:
    """What a page shows besides the material.

    Attributes
    ----------
    against
        Another material to compare with in the page. Repeatable.
    reference
        Folder of mbtf-gen reference to compare with in the page.
    shape
        Mesh with texture coordinates, as another shape of the page.
    environment
        Picture of the surroundings (EXR, HDR, PNG), as light in the page.
    """

    against: list[Path] | None = None
    reference: Path | None = None
    shape: Path | None = None
    environment: Path | None = None


def make_page(material: Path, options: PageOptions) -> tuple[str, str]:
    """HTML of the page of a material folder, and a line about its precision.

    Raises
    ------
    InputError : a material or another file is at fault
    """
    from mbtf_fit.material.material import Material
    from mbtf_fit.viewer.extras import environment_content, mesh_content, pictures_content, poster
    from mbtf_fit.viewer.page import material_content, write_page

    materials = [material_content(folder) for folder in (material, *(options.against or []))]
    content = {
        "materials": [held for held, _ in materials],
        "poster": poster(Material.load(material)),
        **({} if options.reference is None else {"pictures": pictures_content(options.reference)}),
        **({} if options.shape is None else {"mesh": mesh_content(options.shape)}),
        **({} if options.environment is None else {"environment": environment_content(options.environment)}),
    }
    return write_page(content, materials[0][0]["name"]), str(materials[0][1])


def write(export: Export, options: PageOptions) -> list[str]:
    """Write the page. It checks itself by the conformance queries when a browser opens it."""
    from mbtf_fit.export.checks import check_shaders

    check_shaders(export.material, export.folder / PAGE_NAME)
    html, precision = make_page(export.source, options)
    write_document(export.folder / PAGE_NAME, html)
    export.notes.append(precision)
    return [PAGE_NAME]


TARGET = ExportTarget(
    "web",
    "a page that shows the material in a browser, without a network",
    [PAGE_NAME],
    write,
    PageOptions,
    # Its textures have 8 bits or fewer.
    rounds=False,
)
