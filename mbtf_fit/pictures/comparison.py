"""``mbtf-fit compare``: a fitted material beside the path-traced tile that its data set was made from.

A pixel is M for one query, as in ``mbtf-gen reference --kind query``, for both.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mbtf_core.app.console import Console
from mbtf_core.color import (
    auto_exposure,
    chosen_exposure,
    describe_exposure,
    indices,
    palette,
    robust_scale,
    to_display,
    white_of,
)
from mbtf_core.data.dataset import Dataset
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.shard_files import read_exr
from mbtf_core.errors import InputError
from mbtf_core.files.folders import OutputFolder, owned
from mbtf_core.pictures import claim_pictures, write_png
from mbtf_core.run.signals import keep_on_interruption
from mbtf_core.stats import local_error, noise_free_mse, signal_variance, unexplained_variance
from mbtf_core.units import tiles_text
from mbtf_fit.evaluation import check_aspect, foreign_inputs
from mbtf_fit.formatting import format_estimate, visibility
from mbtf_fit.material.material import Material
from mbtf_fit.pictures.config import ComparisonConfig
from mbtf_fit.pictures.grid import color_bar, grid, with_bar
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.pictures.reference import (
    cameras_of,
    check_view,
    note_fine_pixels,
    picture_names,
    render_missing,
)
from mbtf_gen.planning.job import Job

PICTURE_NAME = "comparison.png"
# Smaller pictures are enlarged to about so many pixels across.
_SHOWN = 384
_QUERY = ("u", "sigma", "omega_i", "omega_o")


def _job_of(data: Dataset) -> Job:
    """The data set's job, with its material loaded.

    Raises
    ------
    InputError : the data are measured, or the material is not there or has changed
    """
    if "measured" in data.manifest or data.estimates == 1:
        raise InputError(
            "holds measured data, whose surface is unknown",
            where=data.folder,
            hint="compare with its queries: mbtf-fit evaluate MATERIAL SHARDS",
        )
    try:
        config = GeneratorConfig.model_validate(data.manifest["config"])
    except InputError:
        raise InputError(
            "is of another version, whose configuration is not read",
            where=data.folder,
            hint="generate it again",
        ) from None
    try:
        job = Job.load(config)
    except InputError as error:
        hint = error.hint or "the reference is path-traced from it: run this where mbtf-gen ran"
        raise InputError(error.what, where=error.where, hint=hint) from None
    if job.material.digests != data.manifest["inputs"]:
        raise InputError("has changed since the data set was made", where=job.config.material)
    return job


def compare(config: ComparisonConfig, output: Path, console: Console, *, overwrite: bool = False) -> None:
    """Write references, and one picture of reference, fit and local error; report the errors.

    Parameters
    ----------
    config : material, data set, view and light
    output : the folder
    console : where progress and results go
    overwrite : replace the pictures of another configuration

    Raises
    ------
    UsageError : the view shows the horizon
    InputError : the material or the data set cannot be used, or the folder holds something else
    PartialError : a picture failed; the same command renders the missing ones
    """
    material, data = Material.load(config.material), Dataset.open(DataFolder.open(config.shards))
    job = _job_of(data)
    view = config.picture.resolved(data.lattice.shape()[1], job.material.scatters)
    check_aspect(material, data)
    if foreign := foreign_inputs(material, data):
        differ = f"{', '.join(foreign)} differ{'s' if len(foreign) == 1 else ''}"
        console.note(f"warning: {config.material} was trained on another material ({differ})")
    names = picture_names(view, ["query"])
    check_view(job, view, output, 1)
    note_fine_pixels(cameras_of(view), data.lattice, console)
    keep_on_interruption(f"the finished pictures are kept in {output}")
    with owned(output), console.progress(len(names), "rendering", "pictures") as bar:
        folder = claim_pictures(
            output,
            "mbtf-fit compare",
            files=[*(f"{name}.exr" for name in names.values()), PICTURE_NAME],
            config=config.model_dump(mode="json"),
            inputs={
                "data set": data.manifest["config_hash"],
                "weights": material.description["weights"]["sha256"],
            },
            overwrite=overwrite,
        )
        folder.finished(PICTURE_NAME)  # refuses to replace one that has changed
        render_missing(folder, job, view, ["query"], console, bar.advance)
        known = [folder.finished(name) or {} for name in names.values()]
        bright = [facts["brightness"] for facts in known]
        exposure, peak = chosen_exposure(config.exposure, bright), auto_exposure(bright)
        errors = _draw(folder, material, [*names.values()], view.tiles_across, exposure, peak)
    pictures, lines = [], [f"{output / PICTURE_NAME}: reference, fit, and local RMS error"]
    for across, facts, found in zip(view.tiles_across, known, errors, strict=True):
        pictures.append({"tiles_across": across, "relative_noise": facts["relative_noise"], **found})
        seen = [_rms_text(found), *filter(None, visibility(found))]
        seen.append(f"unexplained variance {format_estimate(found['unexplained'])}")
        if found["mean_ratio"] is not None:
            seen.append(f"mean {found['mean_ratio']:.3f} of the reference's")
        of = f"reference: contrast {found['contrast']:.1%}, noise {facts['relative_noise']:.1%}"
        lines.append(f"{tiles_text(across)} wide: {', '.join(seen)}; {of}")
    lines.append(
        "% of the mean value; unexplained variance is (RMS error / contrast)², large where contrast is low"
    )
    lines.append(f"PSNR has the peak {white_of(peak):.3g} 1/sr; pictures: {describe_exposure(exposure)}")
    report = {"file": output / PICTURE_NAME, "exposure": exposure, "foreign_inputs": foreign}
    console.report({**report, "pictures": pictures}, "\n".join(lines))


def _enlargement(size: int) -> int:
    """How many times a picture of so many pixels across is enlarged."""
    return max(1, _SHOWN // size)


def _enlarged(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    side = len(picture) * _enlargement(len(picture))
    return np.asarray(Image.fromarray(picture).resize((side, side), Image.Resampling.BICUBIC))


def _rms_text(found: dict[str, Any]) -> str:
    mse, error, mean = found["mse"]["value"], found["mse"]["error"], found["mean"]
    significant = mse is not None and error is not None and mse > 2.0 * error
    return f"RMS error {math.sqrt(mse) / mean:.1%}" if significant and mean > 0 else "RMS error within noise"


def _draw(
    folder: OutputFolder,
    material: Material,
    names: list[str],
    widths: list[float],
    exposure: float,
    peak: float,
) -> list[dict[str, Any]]:
    """Write the picture at an exposure; the noise-free errors by width, as
    :func:`mbtf_fit.formatting.visibility` takes them, with the exposure of their `peak`."""
    columns: list[list[Any]] = [[], [], []]
    maps, errors = [], []
    for name in names:
        stored = read_exr(folder.path / f"{name}.exr", (*_QUERY, "value_a", "value_b"))
        stored = {key: array[0] for key, array in stored.items()}
        shape = stored["value_a"].shape
        arrays = (stored[key].reshape(-1, *stored[key].shape[2:]) for key in _QUERY)
        fit = material.evaluate(*arrays)
        halves = [stored[key].reshape(-1, 3) for key in ("value_a", "value_b")]
        reference = 0.5 * (halves[0] + halves[1])
        mse, unexplained = noise_free_mse(fit, *halves), unexplained_variance(fit, *halves)
        mean, variance = float(reference.mean()), signal_variance(*halves).value
        contrast = math.sqrt(max(0.0, variance)) / mean if mean > 0 else 0.0
        ratio = float(fit.mean()) / mean if mean > 0 else None
        numbers = {"exposure": peak, "mean": mean, "mean_ratio": ratio, "contrast": contrast}
        errors.append({"mse": mse.as_dict(), "unexplained": unexplained.as_dict(), **numbers})
        columns[0].append(to_display(reference.reshape(shape), exposure))
        columns[1].append(to_display(fit.reshape(shape), exposure))
        maps.append(local_error(fit.reshape(shape), stored["value_a"], stored["value_b"]))
    # Relative to the mean value, as the errors that are printed.
    unit = float(np.mean([found["mean"] for found in errors])) or 1.0
    scale = robust_scale([[found / unit for found in maps]])
    columns[2] = [palette("local")[indices(found / (scale * unit), "local")] for found in maps]
    size, times = len(maps[0]), _enlargement(len(maps[0]))
    pixels = f"{size} x {size} pixels" + (f", enlarged {times} times" if times > 1 else "")
    captions = [
        f"path-traced reference\nexposure {exposure:+.2f} EV",
        f"fit, one query per pixel\n{pixels}",
        "local RMS error, without noise\n% of the mean value",
    ]
    path = folder.path / PICTURE_NAME
    shown = [[_enlarged(picture) for picture in column] for column in columns]
    sheet = grid(shown, captions, [f"{tiles_text(across)} wide" for across in widths], 3)
    write_png(path, with_bar(sheet, color_bar(size * times, "local", 100.0 * scale, "%")))
    folder.keep(PICTURE_NAME, [path], {"exposure": exposure})
    return errors
