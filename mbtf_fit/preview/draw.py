"""The files of ``mbtf-fit preview``: what is missing is drawn."""

from __future__ import annotations

from pathlib import Path

from mbtf_core.app.console import Console
from mbtf_core.color import describe_exposure, to_display
from mbtf_core.files.folders import OutputFolder, check_space
from mbtf_core.pictures import PNG_BYTES, claim_pictures, write_png
from mbtf_core.run.signals import keep_on_interruption
from mbtf_fit.material.format import read_description
from mbtf_fit.preview.config import MaterialPreviewConfig
from mbtf_gen.engine.runtime import load_mitsuba

SHEET_NAME, GIF_NAME = "sheet.png", "turntable.gif"


def draw(
    config: MaterialPreviewConfig, path: Path, *, sheet_only: bool, overwrite: bool, console: Console
) -> None:
    """Draw the pictures that are missing and report them, in a folder that this process owns.

    Raises
    ------
    InputError : the material cannot be used, or the folder holds something else
    UsageError : a view shows the horizon
    """
    keep_on_interruption(f"the finished pictures are kept in {path}")
    sheet, turn, asked = config.sheet, config.turntable, config.exposure
    counts = len(sheet.view), len(sheet.light), len(sheet.tiles_across)
    pixels = counts[0] * counts[1] * counts[2] * sheet.size**2
    pixels += 0 if sheet_only else turn.frames * turn.size**2
    check_space(path, PNG_BYTES * pixels, "reduce --size or --frames, or choose another folder with -o")
    description, _ = read_description(Path(config.material))
    folder = claim_pictures(
        path,
        "mbtf-fit preview",
        files=(SHEET_NAME, GIF_NAME),
        config=config.model_dump(mode="json"),
        inputs={"weights": description["weights"]["sha256"]},
        overwrite=overwrite,
    )
    shows = {SHEET_NAME: "{} views x {} lights (columns) x {} zooms (rows)".format(*counts)}
    if not sheet_only:
        shows[GIF_NAME] = (
            f"a ball with {turn.tiles} tiles around its equator on a plate; {turn.frames} frames, "
            f"{turn.spp} paths per pixel"
        )
    # The exposure in use, by picture; the turntable has that of the sheet.
    found = {name: folder.finished(name) for name in shows}
    kept = {name: facts is not None and facts["of"] == asked for name, facts in found.items()}
    exposure = (found[SHEET_NAME] or {}).get("exposure", 0.0)
    if not all(kept.values()):
        exposure = _draw_missing(config, folder, kept, exposure, console)
    made = [{"file": path / name, "shows": text, "kept": kept[name]} for name, text in shows.items()]
    lines = [f"{p['file']}: {p['shows']}{' (kept)' if p['kept'] else ''}" for p in made]
    lines.append(describe_exposure(exposure))
    console.report({"folder": path, "pictures": made, "exposure": exposure}, "\n".join(lines))


def _draw_missing(
    config: MaterialPreviewConfig,
    folder: OutputFolder,
    kept: dict[str, bool],
    exposure: float,
    console: Console,
) -> float:
    """Draw pictures that are not kept; returns their exposure."""
    load_mitsuba()
    from mbtf_fit.backends.mitsuba import load_scene
    from mbtf_fit.preview.sheet import contact_sheet, exposure_of, panels
    from mbtf_fit.preview.turntable import frames, write_gif

    bsdf = load_scene({"type": "mbtf", "material": config.material})
    turns = not kept.get(GIF_NAME, True)
    with console.progress(1 + turns * config.turntable.frames, label="drawing", unit="pictures") as bar:
        if not kept[SHEET_NAME]:
            values = panels(bsdf.evaluator, config.sheet)
            exposure = exposure_of(values) if config.exposure is None else config.exposure
            write_png(folder.path / SHEET_NAME, contact_sheet(values, config.sheet, exposure))
            facts = {"exposure": exposure, "of": config.exposure}
            folder.keep(SHEET_NAME, [folder.path / SHEET_NAME], facts)
        bar.advance(1)
        if turns:
            pictures = []
            for picture in frames(bsdf, config.turntable):
                pictures.append(to_display(picture, exposure))
                bar.advance(1)
            write_gif(folder.path / GIF_NAME, pictures)
            facts = {"exposure": exposure, "of": config.exposure}
            folder.keep(GIF_NAME, [folder.path / GIF_NAME], facts)
    return exposure
