"""``mbtf-fit export``: a material in forms that other programs read."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import Output, Overwrite, Switch
from mbtf_core.errors import InputError, UsageError
from mbtf_core.files.folders import OutputKind
from mbtf_core.run.signals import keep_on_interruption
from mbtf_fit.cli.page_options import PAGE_OPTIONS, PageOptions

EXPORT = OutputKind("export.json", "mbtf-export", 3, "an export")


def export_material(
    material: Path,
    /,
    *,
    to: Annotated[
        list[Literal["exr", "json", "material", "web", "slang", "gltf", "usd", "materialx"]] | None,
        Parameter(show_default="exr, json"),
    ] = None,
    output: Annotated[Output | None, Parameter(show_default="the material's own")] = None,
    half: Switch = False,
    shader_target: list[Literal["hlsl", "glsl", "wgsl", "metal", "cuda", "cpp"]] | None = None,
    level: Annotated[int | None, Parameter(show_default="the finest")] = None,
    page: PageOptions = PAGE_OPTIONS,
    overwrite: Overwrite = False,
    console: Console = CONSOLE,
) -> None:
    """Export a material to other programs: mbtf-fit export material/ --to exr

    exr: the latent textures, a part per level and a channel per feature, and those of the transmittance of a
    material with holes. json: the networks as a list of layers, with formulas, conventions and queries with
    expected values. material: another material folder, in a folder of its own; the same command again keeps
    it. web: a page that shows the material in a browser, without a network. slang: a shader module and the
    buffer that it reads. gltf, usd, materialx: maps for programs that evaluate no networks, of the surface
    that the model knows or fitted to its values; without shadows, interreflection and parallax, but with the
    same mean reflectance.

    Parameters
    ----------
    material
        Folder made by mbtf-fit.
    to
        Format to write. Repeatable.
    shader_target
        Another language that Slang compiles the module to; needs the extra 'shaders'. Repeatable.
    level
        Level of the maps of gltf, usd and materialx.
    half
        Round all weights and texels to 16 bits first, and print the resulting error; not for web.
    """
    from mbtf_core.files.atomic import file_sha256, write_text
    from mbtf_core.files.folders import OutputFolder, owned
    from mbtf_fit.backends.shader.slang import FILE_NAMES, write_module
    from mbtf_fit.material.export import LAYERS_NAME, TEXTURES_NAME, to_half, write_layers, write_textures
    from mbtf_fit.material.format import DESCRIPTION_NAME, WEIGHTS_NAME
    from mbtf_fit.material.interchange.documents import WRITERS
    from mbtf_fit.material.interchange.images import BASE_COLOR, HEIGHT, NORMAL, ORM
    from mbtf_fit.material.interchange.maps import level_of
    from mbtf_fit.material.interchange.write import Interchange, write_interchange
    from mbtf_fit.material.material import Material, export
    from mbtf_fit.material.transmittance import TRANSMITTANCE_NAME
    from mbtf_fit.viewer.page import PAGE_NAME

    wanted = list(dict.fromkeys(to or ["exr", "json"]))
    if page.given() and "web" not in wanted:
        raise UsageError("is an option of pages", where=page.given()[0], hint="add --to web")
    folder = material if output is None else output
    tools = [name for name in wanted if name in WRITERS]
    if level is not None and not tools:
        raise UsageError("is an option of maps", where="--level", hint="add --to gltf, usd or materialx")
    if shader_target and "slang" not in wanted:
        raise UsageError("is an option of shaders", where="--shader-target", hint="add --to slang")
    if half and "web" in wanted:
        raise UsageError(
            "has no meaning for pages, whose textures have 8 bits or fewer",
            where="--half",
            hint="leave it out, or export the page by a command of its own",
        )
    loaded = Material.load(material)
    keep_on_interruption(f"the finished files are kept in {folder}")
    depends = {
        "material": file_sha256(material / DESCRIPTION_NAME),
        "to": sorted(wanted),
        "half": half,
        "shader_target": sorted(set(shader_target or [])),
        "level": level,
        "page": page.digests(),
    }
    # The description goes first: without it nothing counts as a finished material.
    names = [DESCRIPTION_NAME, TEXTURES_NAME, LAYERS_NAME, WEIGHTS_NAME, TRANSMITTANCE_NAME, PAGE_NAME]
    names += [*FILE_NAMES, BASE_COLOR, NORMAL, ORM, HEIGHT, *(document for document, _ in WRITERS.values())]
    # Files of other formats may lie in the material's own folder.
    beside = "material" not in wanted and folder.is_dir() and folder.samefile(material)
    with (
        owned(folder),
        nullcontext() if beside else OutputFolder.claim(folder, EXPORT, depends, names, overwrite=overwrite),
    ):
        written, error = loaded, None
        if half:
            written, error = to_half(loaded)
        made: Interchange | None = None
        files: list[str] = []
        notes = [] if error is None else [str(error)]
        if "exr" in wanted:
            write_textures(written, folder / TEXTURES_NAME, half=half)
            files.append(TEXTURES_NAME)
        if "json" in wanted:
            write_layers(written, folder / LAYERS_NAME, half=half)
            files.append(LAYERS_NAME)
        if "slang" in wanted:
            files += write_module(written, folder, list(dict.fromkeys(shader_target or [])))
        if tools:
            label = "fitting maps"
            with console.progress(total=loaded.lattice.texels(level_of(loaded, level)), label=label) as bar:
                made = write_interchange(written, material, folder, tools, level, bar.advance)
            files += made.files
            notes.append(str(made))
        if "web" in wanted:
            html, precision = page.page(material)
            write_text(folder / PAGE_NAME, html)
            files.append(PAGE_NAME)
            notes.append(precision)
        if "material" in wanted:
            description = loaded.description
            if not _is_material(folder):
                export(
                    written.model,
                    written.config,
                    folder,
                    data=description["data"],
                    training=description["training"],
                    half=half,
                    transmittance=written.transmittance,
                )
            files += [WEIGHTS_NAME, DESCRIPTION_NAME, *([TRANSMITTANCE_NAME] if loaded.transmittance else [])]
    sizes = {name: (folder / name).stat().st_size for name in files}
    lines = [f"{folder / name}: {size / 1e6:.3f} MB" for name, size in sizes.items()]
    console.report(
        {
            "folder": folder,
            "files": sizes,
            "half": None if error is None else asdict(error),
            "maps": None if made is None else made.as_dict(),
        },
        "\n".join([*lines, *notes]),
    )


def _is_material(folder: Path) -> bool:
    from mbtf_fit.material.material import Material

    try:
        Material.load(folder)
    except InputError:
        return False
    return True
