"""``mbtf-fit export`` and ``mbtf-fit view``: a material in forms that other programs read, browsers too."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import Output, Overwrite, whole_number
from mbtf_core.errors import InputError, UsageError
from mbtf_core.files.folders import OutputKind
from mbtf_core.run.signals import keep_on_interruption, served_until_interruption
from mbtf_fit.export import Export, targets
from mbtf_fit.export.images import MapOptions
from mbtf_fit.export.slang import ShaderOptions
from mbtf_fit.export.web import PageOptions, make_page
from mbtf_fit.material.texture_formats import TextureFormat

if TYPE_CHECKING:
    Name = str
else:
    Name = Literal[tuple(targets())]

EXPORT = OutputKind("export.json", "mbtf-export", 3, "an export")


def export_material(
    material: Path,
    /,
    *,
    to: Annotated[
        list[Name] | None,
        Parameter(
            show_default="exr, json",
            help="Format to write. Repeatable. "
            + " ".join(f"{t.name}: {t.help}." for t in targets().values()),
        ),
    ] = None,
    output: Annotated[Output | None, Parameter(show_default="the material's own")] = None,
    texture_format: Annotated[TextureFormat | None, Parameter(show_default="the material's own")] = None,
    maps: MapOptions = MapOptions(),  # noqa: B008
    page: PageOptions = PageOptions(),  # noqa: B008
    shader: ShaderOptions = ShaderOptions(),  # noqa: B008
    overwrite: Overwrite = False,
    console: Console = CONSOLE,
) -> None:
    """Export a material to other programs.

    For example: mbtf-fit export material/ --to exr

    Parameters
    ----------
    material
        Folder made by mbtf-fit.
    texture_format
        Round the textures first, and print the resulting error; not for web. float16 rounds the networks too;
        bc4 is read by graphics hardware.
    """
    from mbtf_core.files.atomic import file_sha256
    from mbtf_core.files.folders import OutputFolder, owned
    from mbtf_fit.material.format import DESCRIPTION_NAME
    from mbtf_fit.material.material import Material
    from mbtf_fit.material.rounding import round_material

    wanted = [targets()[name] for name in dict.fromkeys(to or ["exr", "json"])]
    sections: dict[Any, Any] = {type(section): section for section in (maps, page, shader)}
    given = {kind: {k: v for k, v in vars(s).items() if v is not None} for kind, s in sections.items()}
    for kind, flags in given.items():
        users = [t.name for t in targets().values() if t.options is kind]
        if flags and not {t.name for t in wanted} & set(users):
            flag = f"--{next(iter(flags)).replace('_', '-')}"
            raise UsageError(f"is an option of {', '.join(users)}", where=flag, hint=f"add --to {users[0]}")
    for target in wanted:
        if texture_format and not target.rounds:
            hint = "leave it out, or export the other formats by a command of their own"
            raise UsageError(f"has no meaning for {target.name}", where="--texture-format", hint=hint)
    loaded, folder = Material.load(material), material if output is None else output
    keep_on_interruption(f"the finished files are kept in {folder}")
    depends = {
        "material": file_sha256(material / DESCRIPTION_NAME),
        "to": sorted(target.name for target in wanted),
        "texture_format": texture_format,
        "options": {k: digest_of(v) for k, v in sorted(kv for f in given.values() for kv in f.items())},
    }
    # Files of other formats may lie in the material's own folder.
    beside = folder.is_dir() and folder.samefile(material)
    beside = beside and not any(DESCRIPTION_NAME in target.files for target in wanted)
    if beside and not overwrite:
        there = next((n for target in wanted for n in target.files if (folder / n).exists()), None)
        if there is not None:
            hint = "write to another folder with -o, or replace it with --overwrite"
            raise InputError("is there already", where=folder / there, hint=hint)
    # The description goes first: without it nothing counts as a finished material.
    names = dict.fromkeys([DESCRIPTION_NAME, *(name for t in targets().values() for name in t.files)])
    with (
        owned(folder),
        nullcontext()
        if beside
        else OutputFolder.claim(folder, EXPORT, depends, names, overwrite=overwrite) as claimed,
    ):
        if claimed is not None:
            # Refuses to replace files that have changed.
            claimed.finished(EXPORT.format)
        written, error = round_material(loaded, texture_format) if texture_format else (loaded, None)
        form = texture_format or loaded.texture_format
        export = Export(material, folder, written, form, console)
        if error is not None:
            export.notes.append(str(error))
        files: list[str] = []
        for target in wanted:
            files += target.write(export, sections.get(target.options))
        if claimed is not None:
            claimed.keep(EXPORT.format, [folder / name for name in dict.fromkeys(files)], {})
    sizes = {name: (folder / name).stat().st_size for name in dict.fromkeys(files)}
    lines = [f"{folder / name}: {size / 1e6:.3f} MB" for name, size in sizes.items()]
    report = {"folder": folder, "files": sizes, "rounding": None if error is None else asdict(error)}
    console.report(report | export.report, "\n".join([*lines, *export.notes]))


def digest_of(value: Any) -> Any:
    """A value of a flag, of paths the digests of their files; of a folder those of its records."""
    from mbtf_core.files.atomic import file_sha256

    if isinstance(value, list):
        return [digest_of(item) for item in value]
    if not isinstance(value, Path):
        return value
    if value.is_dir():
        return [file_sha256(file) for file in sorted(value.glob("*.json"))]
    return file_sha256(value) if value.is_file() else "missing"


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
