"""The command ``mbtf-fit preview``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from mbtf_core.console import CONSOLE, Console
from mbtf_core.errors import UsageError

SHEET_NAME, TURNTABLE_NAME = "sheet.png", "turntable.gif"


def preview(
    material: Path | None = None,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("preview"),
    tiles_across: str | None = None,
    size: int | None = None,
    turn_size: int | None = None,
    frames: int | None = None,
    spp: int | None = None,
    tiles: int | None = None,
    config: Path | None = None,
    assignments: Annotated[
        list[str] | None,
        Parameter(name="--set", help="Set any option of the configuration, a.b=c. Repeatable."),
    ] = None,
    overwrite: Annotated[bool, Parameter(negative="")] = False,
    console: Console = CONSOLE,
) -> None:
    """Draw a material: a contact sheet of views, lights and widths, and a turntable.

    Needs neither a scene nor PyTorch. Writes sheet.png and turntable.gif.

    Parameters
    ----------
    material
        Folder made by mbtf-fit.
    output
        Folder of pictures.
    tiles_across
        Widths of the sheet's pictures in tiles. Default: 1,4,16
    size
        Pixels along each side of a picture of the sheet. Default: 160
    turn_size
        Pixels along each side of the turntable. Default: 240
    frames
        Frames of one rotation. Default: 24
    spp
        Paths per pixel of the turntable. Default: 16
    tiles
        Tiles around the turntable's ball. Default: 8
    config
        YAML file with the options.
    overwrite
        Draw again, and replace pictures of another configuration.
    """
    from mbtf_core.config_file import resolve
    from mbtf_fit.mitsuba_plugin.preview.config import PreviewConfig
    from mbtf_gen.cli.common import numbers

    if material is None and config is None:
        raise UsageError("no material given", hint="mbtf-fit preview material/ -o preview/")
    flags = {
        "--tiles-across": ("sheet.tiles_across", numbers(tiles_across, "--tiles-across")),
        "--size": ("sheet.size", size),
        "--turn-size": ("turntable.size", turn_size),
        "--frames": ("turntable.frames", frames),
        "--spp": ("turntable.spp", spp),
        "--tiles": ("turntable.tiles", tiles),
    }
    resolved = resolve(
        PreviewConfig,
        file=config,
        assignments=assignments or [],
        flags={"material": None if material is None else str(material), **dict(flags.values())},
        spelled={key: flag for flag, (key, _) in flags.items()},
    )
    if material is None and config is not None:
        # A path in a file is relative to that file, so that the file works from anywhere.
        resolved = resolved.model_copy(update={"material": str(config.parent / resolved.material)})
    draw(resolved, output, overwrite=overwrite, console=console)


def draw(config: Any, path: Path, *, overwrite: bool, console: Console) -> None:
    """Draw the missing pictures and report all.

    Raises
    ------
    InputError : the material cannot be used, or the folder holds something else
    UsageError : a view shows the horizon
    """
    from mbtf_fit.material.format import read_description
    from mbtf_gen.pictures.folder import PictureFolder
    from mbtf_gen.render.runtime import load_mitsuba

    description, _ = read_description(Path(config.material))
    folder = PictureFolder.claim(
        path,
        "material",
        command="mbtf-fit preview",
        files=(SHEET_NAME, TURNTABLE_NAME),
        config=config.model_dump(mode="json"),
        inputs={"weights": description["weights"]["sha256"]},
        overwrite=overwrite,
    )
    sheet, turn = config.sheet, config.turntable
    shows = {
        SHEET_NAME: f"{len(sheet.views)} views x {len(sheet.lights)} lights (columns) x "
        f"{len(sheet.tiles_across)} widths (rows) at one exposure",
        TURNTABLE_NAME: f"a ball of {turn.tiles} tiles around on a plate, {turn.frames} pictures of "
        f"{turn.spp} paths per pixel",
    }
    kept = {name: folder.finished(name) is not None for name in shows}
    if not all(kept.values()):
        load_mitsuba()
        from mbtf_fit.mitsuba_plugin.preview.pictures import Pictures

        with console.progress(total=turn.frames + 1, label="drawing", unit="pictures") as bar:
            pictures = Pictures(config)
            if not kept[SHEET_NAME]:
                pictures.sheet(folder.path / SHEET_NAME)
                folder.keep(SHEET_NAME, [folder.path / SHEET_NAME], {})
            bar.advance(1)
            if not kept[TURNTABLE_NAME]:
                pictures.turntable(folder.path / TURNTABLE_NAME, lambda: bar.advance(1))
                folder.keep(TURNTABLE_NAME, [folder.path / TURNTABLE_NAME], {})
    made = [{"file": folder.path / name, "shows": text, "kept": kept[name]} for name, text in shows.items()]
    lines = [f"{p['file']}: {p['shows']}{' (kept)' if p['kept'] else ''}" for p in made]
    console.report({"folder": path, "pictures": made}, "\n".join(lines))
