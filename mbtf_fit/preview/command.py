"""The files of ``mbtf-fit preview``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from mbtf_core.app.console import Console
from mbtf_core.run.signals import keep_on_interruption

if TYPE_CHECKING:
    from mbtf_fit.preview.config import MaterialPreviewConfig

SHEET_NAME, GIF_NAME, MP4_NAME = "sheet.png", "turntable.gif", "turntable.mp4"


def draw(
    config: MaterialPreviewConfig,
    path: Path,
    *,
    sheet_only: bool,
    mp4: bool,
    overwrite: bool,
    console: Console,
) -> None:
    """Draw the pictures that are missing and report them, in a folder that this process owns.

    Parameters
    ----------
    sheet_only : no turntable
    mp4 : the turntable as MP4, too

    Raises
    ------
    InputError : the material cannot be used, or the folder holds something else
    UsageError : a view shows the horizon
    EngineError : MP4 is asked for, and there is no ffmpeg
    """
    from mbtf_core.color import describe_exposure, to_display
    from mbtf_core.files.folders import check_space
    from mbtf_core.pictures import PNG_BYTES, claim_pictures, write_png
    from mbtf_fit.backends.mitsuba import load_scene
    from mbtf_fit.material.format import read_description
    from mbtf_fit.preview.animation import find_encoder, write_gif, write_mp4
    from mbtf_gen.engine.runtime import load_mitsuba

    keep_on_interruption(f"the finished pictures are kept in {path}")
    encoder = find_encoder() if mp4 else ""
    sheet, turn, asked = config.sheet, config.turntable, config.exposure
    panels_of = len(sheet.cameras) * len(sheet.lamps) * len(sheet.tiles_across)
    size = PNG_BYTES * panels_of * sheet.size**2
    if not sheet_only:
        size += PNG_BYTES * turn.frames * turn.size**2
    check_space(path, size, "reduce --size or --frames, or choose another folder with -o")
    description, _ = read_description(Path(config.material))
    folder = claim_pictures(
        path,
        "mbtf-fit preview",
        files=(SHEET_NAME, GIF_NAME, MP4_NAME),
        config=config.model_dump(mode="json"),
        inputs={"weights": description["weights"]["sha256"]},
        overwrite=overwrite,
    )
    ball = f"a ball with {turn.tiles} tiles around its equator on a plate; "
    ball += f"{turn.frames} frames, {turn.spp} paths per pixel"
    shows = {
        SHEET_NAME: f"{_count(sheet.cameras, 'view')} x {_count(sheet.lamps, 'light')} (columns) x "
        f"{_count(sheet.tiles_across, 'zoom')} (rows)"
    }
    if not sheet_only:
        shows |= {GIF_NAME: ball, **({MP4_NAME: ball} if mp4 else {})}
    # The exposure in use, by picture; the turntable has that of the sheet.
    found = {name: folder.finished(name) for name in shows}
    kept = {name: facts is not None and facts["of"] == asked for name, facts in found.items()}
    exposure = (found[SHEET_NAME] or {}).get("exposure", 0.0)
    if not all(kept.values()):
        load_mitsuba()
        from mbtf_fit.preview.sheet import contact_sheet, exposure_of, panels
        from mbtf_fit.preview.turntable import frames

        bsdf = load_scene({"type": "mbtf", "material": config.material})
        missing = [name for name in shows if not kept[name] and name != SHEET_NAME]
        total = 1 + turn.frames * bool(missing)
        with console.progress(total=total, label="drawing", unit="pictures") as bar:
            if not kept[SHEET_NAME]:
                values = panels(bsdf.evaluator, sheet)
                exposure = exposure_of(values) if asked is None else asked
                write_png(folder.path / SHEET_NAME, contact_sheet(values, sheet, exposure))
                folder.keep(SHEET_NAME, [folder.path / SHEET_NAME], {"exposure": exposure, "of": asked})
            bar.advance(1)
            if missing:
                pictures = []
                for picture in frames(bsdf, turn):
                    pictures.append(to_display(picture, exposure))
                    bar.advance(1)
                for name in missing:
                    if name == GIF_NAME:
                        write_gif(folder.path / name, pictures)
                    else:
                        write_mp4(folder.path / name, pictures, encoder)
                    folder.keep(name, [folder.path / name], {"exposure": exposure, "of": asked})
    made = [{"file": folder.path / name, "shows": text, "kept": kept[name]} for name, text in shows.items()]
    lines = [f"{p['file']}: {p['shows']}{' (kept)' if p['kept'] else ''}" for p in made]
    lines.append(describe_exposure(exposure))
    console.report({"folder": path, "pictures": made, "exposure": exposure}, "\n".join(lines))


def _count(items: list[Any], name: str) -> str:
    return f"{len(items)} {name}{'' if len(items) == 1 else 's'}"
