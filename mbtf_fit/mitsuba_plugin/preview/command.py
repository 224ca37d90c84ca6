"""The files of ``mbtf-fit preview``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from mbtf_core.console import Console
from mbtf_core.folders import owned
from mbtf_core.interruption import keep_on_interruption

if TYPE_CHECKING:
    from mbtf_fit.mitsuba_plugin.preview.config import PreviewConfig

SHEET_NAME, TURNTABLE_NAME = "sheet.png", "turntable.gif"


def draw(config: PreviewConfig, path: Path, *, overwrite: bool, console: Console) -> None:
    """Draw the pictures that are missing and report them.

    Raises
    ------
    InputError : the material cannot be used, or the folder holds something else
    UsageError : a view shows the horizon
    PartialError : another process writes to the folder
    """
    keep_on_interruption(f"the finished pictures are kept in {path}")
    with owned(path):
        _draw(config, path, overwrite, console)


def _draw(config: PreviewConfig, path: Path, overwrite: bool, console: Console) -> None:
    from mbtf_fit.material.format import read_description
    from mbtf_fit.mitsuba_plugin import load_scene
    from mbtf_gen.pictures.folder import PictureFolder
    from mbtf_gen.pictures.reference import write_png
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
        f"{len(sheet.tiles_across)} zooms (rows), one exposure",
        TURNTABLE_NAME: f"a ball with {turn.tiles} tiles around its equator on a plate; "
        f"{turn.frames} frames, {turn.spp} paths per pixel",
    }
    kept = {name: folder.finished(name) is not None for name in shows}
    if not all(kept.values()):
        load_mitsuba()
        from mbtf_fit.mitsuba_plugin.preview.sheet import contact_sheet, panels
        from mbtf_fit.mitsuba_plugin.preview.turntable import frames, to_pictures, write_gif

        bsdf = load_scene({"type": "mbtf", "material": config.material})
        with console.progress(total=turn.frames + 1, label="drawing", unit="pictures") as bar:
            if not kept[SHEET_NAME]:
                write_png(folder.path / SHEET_NAME, contact_sheet(panels(bsdf.evaluator, sheet), sheet))
                folder.keep(SHEET_NAME, [folder.path / SHEET_NAME], {})
            bar.advance(1)
            if not kept[TURNTABLE_NAME]:
                pictures = []
                for picture in frames(bsdf, turn):
                    pictures.append(picture)
                    bar.advance(1)
                write_gif(folder.path / TURNTABLE_NAME, to_pictures(pictures))
                folder.keep(TURNTABLE_NAME, [folder.path / TURNTABLE_NAME], {})
    made = [{"file": folder.path / name, "shows": text, "kept": kept[name]} for name, text in shows.items()]
    lines = [f"{p['file']}: {p['shows']}{' (kept)' if p['kept'] else ''}" for p in made]
    console.report({"folder": path, "pictures": made}, "\n".join(lines))
