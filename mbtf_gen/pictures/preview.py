"""The picture of ``mbtf-gen preview``."""

from __future__ import annotations

from pathlib import Path

from mbtf_core.app.console import Console
from mbtf_core.color import brightness, chosen_exposure, describe_exposure
from mbtf_core.directions import from_angles
from mbtf_core.files.folders import check_space, owned
from mbtf_core.pictures import PNG_BYTES, claim_pictures, tiles_camera, write_display
from mbtf_core.stats import pooled_relative_error
from mbtf_gen.config.pictures import PreviewConfig
from mbtf_gen.pictures.reference import (
    note_fine_pixels,
    picture_estimator,
    render_reference,
)
from mbtf_gen.planning.job import Job

# Noise relative to the mean value from which more paths are recommended.
_NOISY = 0.2


def draw_preview(config: PreviewConfig, path: Path, console: Console, *, overwrite: bool = False) -> None:
    """Draw the picture of a material in a folder, and report it.

    Raises
    ------
    InputError : the material cannot be read, or the folder holds something else
    UsageError : the view shows the horizon
    """
    options, job = config.preview, Job.load(config)
    job.announce_briefly()
    size, spp = options.sizes(job.material.scatters)
    camera = tiles_camera(
        options.view.elevation,
        options.view.azimuth,
        tiles=options.tiles,
        aspect=job.material.aspect,
        displacement_range=job.material.thickness,
        columns=size,
    )
    omega_i = from_angles(options.light.elevation, options.light.azimuth)
    camera.queries(omega_i, job.material.aspect)  # refuses a view of the horizon
    options = options.model_copy(update={"size": size, "spp": spp})
    config = config.model_copy(update={**dict(job.config), "preview": options})
    file, paths = path / "beauty.png", camera.rows * camera.columns * spp
    note_fine_pixels([camera], job.lattice, console)
    check_space(path, PNG_BYTES * size**2, "reduce --size, or choose another folder with -o")
    with owned(path), console.progress(100, "drawing", "%") as bar:
        claim_pictures(
            path,
            "mbtf-gen preview",
            files=[file.name],
            config=config.model_dump(mode="json"),
            inputs=job.material.digests,
            overwrite=overwrite,
        )
        bar.update(0, "building the scene, compiling kernels")
        estimator = picture_estimator(job)
        estimator.observe = lambda count: bar.advance(100 * count / paths, "")
        image = render_reference(estimator, camera, omega_i, kind="pixel", spp=spp, seed=config.seed)
        exposure = chosen_exposure(config.exposure, [brightness(image.value)])
        write_display(file.with_suffix(""), image.value, exposure)
    noise = pooled_relative_error(image.value_a.reshape(-1, 3), image.value_b.reshape(-1, 3)).value
    shows = f"path-traced with {spp} paths per pixel, noise {noise:.0%} of the mean value"
    shows += f"; --spp {4 * spp} halves it" if noise > _NOISY else ""
    console.report(
        {"folder": path, "pictures": [{"file": file, "shows": shows}], "exposure": exposure},
        f"{file}: {shows}\n{describe_exposure(exposure)}",
    )
