"""The pictures of ``mbtf-gen preview``: path-traced picture, and query distribution."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mbtf_core.app.console import Console
from mbtf_core.color import brightness, chosen_exposure, describe_exposure
from mbtf_core.directions import from_angles
from mbtf_core.files.folders import check_space, owned
from mbtf_core.pictures import PNG_BYTES, Camera, claim_pictures, tiles_camera, write_display
from mbtf_core.stats import pooled_relative_error
from mbtf_core.units import rate_text
from mbtf_gen.config.pictures import PreviewConfig
from mbtf_gen.job import Job
from mbtf_gen.pictures.query_plots import write_plots
from mbtf_gen.pictures.reference import (
    note_fine_pixels,
    picture_estimator,
    render_reference,
)

# Noise relative to the mean value from which more paths are recommended.
_NOISY = 0.2


@dataclass(frozen=True)
class _Scene:
    """A material as its picture shows it."""

    config: PreviewConfig
    job: Job
    camera: Camera
    omega_i: NDArray[np.float64]
    size: int
    spp: int

    def beauty(self, file: Path, advance: Callable[[float, str], None]) -> tuple[str, float]:
        """Write the path-traced picture; returns what it shows, and its exposure. `advance` is called with
        the share of its paths that are traced, and their rate."""
        advance(0.0, "building the scene, compiling kernels")
        estimator = picture_estimator(self.job)
        paths = self.camera.rows * self.camera.columns * self.spp
        traced, began = 0, time.perf_counter()

        def observe(count: int) -> None:
            nonlocal traced
            traced += count
            advance(traced / paths, rate_text(traced / (time.perf_counter() - began)))

        estimator.observe = observe
        image = render_reference(
            estimator, self.camera, self.omega_i, kind="pixel", spp=self.spp, seed=self.config.seed
        )
        noise = pooled_relative_error(image.value_a.reshape(-1, 3), image.value_b.reshape(-1, 3)).value
        exposure = chosen_exposure(self.config.exposure, [brightness(image.value)])
        write_display(file.with_suffix(""), image.value, exposure)
        more = f"; --spp {4 * self.spp} halves it" if noise > _NOISY else ""
        shows = (
            f"the infinite plane from the same camera, path-traced with {self.spp} paths per pixel, noise "
            f"{noise:.0%} of the mean value{more}"
        )
        return shows, exposure


def draw_preview(config: PreviewConfig, path: Path, console: Console, *, overwrite: bool = False) -> None:
    """Draw the pictures of a material in a folder, and report them.

    Raises
    ------
    InputError : the material cannot be read, or the folder holds something else
    UsageError : the view shows the horizon
    """
    scene = _scene(config)
    names = ["beauty", "queries"]
    files, shown = {name: path / f"{name}.png" for name in names}, dict[str, str]()
    note_fine_pixels([scene.camera], scene.job.lattice, console)
    size = len(names) * PNG_BYTES * scene.size**2
    check_space(path, size, "reduce --size, or choose another folder with -o")
    with owned(path), console.progress(len(names), "drawing", "pictures") as bar:
        claim_pictures(
            path,
            "mbtf-gen preview",
            files=[file.name for file in files.values()],
            config=scene.config.model_dump(mode="json"),
            inputs=scene.job.material.digests,
            overwrite=overwrite,
        )
        shown["beauty"], exposure = scene.beauty(
            files["beauty"], lambda share, note: bar.update(round(share, 2), note)
        )
        shown["queries"] = write_plots(files["queries"], scene.job)
        bar.update(len(names), "")
    text = "\n".join([*(f"{files[name]}: {shown[name]}" for name in names), describe_exposure(exposure)])
    pictures = [{"file": files[name], "shows": shown[name]} for name in names]
    console.report({"folder": path, "pictures": pictures, "exposure": exposure}, text)


def _scene(config: PreviewConfig) -> _Scene:
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
    return _Scene(config, job, camera, omega_i, size, spp)
