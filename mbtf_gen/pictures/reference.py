"""Reference pictures: path-traced from the micro-geometry, with both halves.

A picture is stored as an EXR image with the channels of the shard schema (``u.x``, ``omega_o.z``,
``value_a.R``, …), so that a fitted material can be evaluated at its queries, and as a PNG for display.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from numpy.typing import ArrayLike

from mbtf_core.app.console import Console
from mbtf_core.color import brightness, chosen_exposure, describe_exposure
from mbtf_core.data.lattice import Lattice
from mbtf_core.data.schema import Queries
from mbtf_core.data.shard_files import row_bytes
from mbtf_core.directions import from_angles
from mbtf_core.errors import PartialError, UsageError, check_type
from mbtf_core.files.atomic import file_sha256
from mbtf_core.files.folders import OutputFolder, check_space, owned
from mbtf_core.pictures import (
    PIXEL_SIGMA,
    PNG_BYTES,
    Camera,
    PixelKind,
    ReferenceImage,
    claim_pictures,
    read_value,
    write_display,
)
from mbtf_core.run.cluster import open_runner
from mbtf_core.run.signals import keep_on_interruption
from mbtf_core.run.task import Item
from mbtf_core.stats import pooled_relative_error
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.config.pictures import ReferenceConfig, ReferenceSection, Shape, ViewSection
from mbtf_gen.pictures.displaced_mesh import DisplacedMesh
from mbtf_gen.pictures.shapes import Chart, render_shape
from mbtf_gen.planning.job import Job
from mbtf_gen.planning.run_plan import reference_plan
from mbtf_gen.planning.simulation import build_estimator

if TYPE_CHECKING:
    from mbtf_gen.render.estimator import Estimator

# Pixels that cover less of a texel are finer than the data; 1 but for rounding.
_TEXEL = 0.99
_kept: tuple[Job, Any] | None = None


def _camera_rays(camera: Camera, estimator: Estimator) -> Any:
    """Source of first rays whose n-th query is the camera's n-th pixel under its Gaussian filter."""
    import drjit as dr
    import mitsuba as mi

    from mbtf_gen.render.scene import CLEARANCE, ray_through

    tile = estimator.tile

    def numbers(*values: float) -> list[Any]:
        """Opaque, so that all cameras share the compiled kernel."""
        return [dr.opaque(mi.Float, float(v)) for v in values]

    forward, right, up = (mi.Vector3f(*numbers(*axis)) for axis in camera.frame())
    position = mi.Point3f(*numbers(*camera.position))
    unit, aspect, start, pitch = numbers(tile.unit, tile.aspect, CLEARANCE, camera.pixel_pitch)
    center_x, center_y = numbers(camera.columns / 2 - 0.5, camera.rows / 2 - 0.5)
    columns = dr.opaque(mi.UInt32, camera.columns)

    class CameraRays:
        def set_queries(self, queries: Queries, first: int = 0) -> None:
            self.first = dr.opaque(mi.UInt32, first)

        def footprint(self, query: Any, xi: Any) -> Any:
            pixel = query + self.first
            jitter = mi.warp.square_to_std_normal(xi) * PIXEL_SIGMA
            row = pixel // columns
            x = (mi.Float(pixel - row * columns) - center_x + jitter.x) * pitch
            y = (center_y - mi.Float(row) + jitter.y) * pitch
            d = forward + right * x + up * y
            # The filter's tail may reach the horizon, with negligible weight.
            t = position.z / dr.maximum(-d.z, 1e-4)
            return mi.Point2f(position.x + t * d.x, (position.y + t * d.y) / aspect)

        def ray(self, query: Any, point: Any) -> Any:
            towards = mi.Vector3f(position.x - point.x, position.y - point.y * aspect, position.z)
            return ray_through(point, dr.normalize(towards), unit, aspect, start)

    return CameraRays()


def render_reference(
    source: GeneratorConfig | Job | Estimator,
    camera: Camera,
    omega_i: ArrayLike,
    *,
    kind: PixelKind = "query",
    spp: int = 256,
    seed: int = 0,
    index: int = 0,
) -> ReferenceImage:
    """Path-trace one picture of a material on the plane.

    Parameters
    ----------
    source : GeneratorConfig, Job or Estimator
        The material, the light and the effects; without ``effects.mode``, all that the material has.
    camera : the camera
    omega_i : (3,) float array
        Unit vector towards the light.
    kind : {"query", "pixel"}
        Meaning of a pixel, see :mod:`mbtf_core.pictures`.
    spp : paths per pixel, both halves together; even
    seed, index : root seed of the random numbers, and number of the picture

    Returns
    -------
    ReferenceImage
        The picture and its queries.

    Raises
    ------
    UsageError : the picture shows the horizon
    InputError : the material cannot be used, or `omega_i` is not a unit vector
    """
    from mbtf_gen.render.estimates import Stream

    job = Job.load(source) if isinstance(source, GeneratorConfig) else source
    if not isinstance(job, Job) and not hasattr(job, "estimate"):
        check_type(job, GeneratorConfig, "source", "such as GeneratorConfig(material='heights.exr')")
    estimator: Any = picture_estimator(job) if isinstance(job, Job) else job
    queries = camera.queries(omega_i, estimator.tile.aspect)
    rays = _camera_rays(camera, estimator) if kind == "pixel" else None
    stream = Stream(seed, "reference", 2 * index + (kind == "pixel"))
    estimates = estimator.estimate(queries.flat(), spp, stream, rays)
    shape, through = (*queries.lead, 3), estimates.transmittance
    return ReferenceImage(
        estimates.value_a.reshape(shape),
        estimates.value_b.reshape(shape),
        spp,
        None if through is None else through.reshape(queries.lead),
        queries,
    )


def picture_estimator(job: Job) -> Any:
    """The estimator of a job's pictures, kept for the next one."""
    global _kept
    if _kept is None or _kept[0] is not job:
        _kept = job, build_estimator(job, reference_plan(job))
    return _kept[1]


def cameras_of(view: ViewSection) -> list[Camera]:
    """A camera for each width of the field of view."""
    direction, size = view.view, view.size
    return [
        Camera(direction.elevation, direction.azimuth, across, rows=size, columns=size)
        for across in view.tiles_across
    ]


def picture_names(
    view: ViewSection, kinds: Sequence[PixelKind], surface: Chart | DisplacedMesh | None = None
) -> dict[tuple[Camera, PixelKind], str]:
    """Names of pictures, without suffix."""
    return {
        (camera, kind): f"{surface.name if surface else kind}-tiles{camera.tiles_across:g}"
        for camera, kind in product(cameras_of(view), kinds)
    }


def _surface(view: ReferenceSection, aspect: float) -> Chart | DisplacedMesh | None:
    """What the tiles cover besides a plane."""
    tiles = 13.0 if view.tiles is None else view.tiles
    if view.surface == "plane":
        return None
    for shape in get_args(Shape):
        if shape == view.surface:
            return Chart(shape, int(tiles), aspect)
    return DisplacedMesh.read(Path(view.surface), tiles, aspect, view.up)


def check_view(
    job: Job, view: ViewSection, output: Path, kinds: int, surface: Chart | DisplacedMesh | None = None
) -> None:
    """Refuse pictures that show the horizon (UsageError) or do not fit on the disk (InputError)."""
    check_space(
        output,
        len(view.tiles_across) * kinds * _picture_bytes(job, view),
        "reduce --size, or choose another folder with -o",
    )
    camera = min(cameras_of(view), key=lambda c: c.tiles_across)
    if surface is None:
        camera.queries(from_angles(90, 0))
    elif camera.distance <= surface.radius:
        least = math.ceil(10.0 * surface.radius * camera.tiles_across / camera.distance) / 10.0
        what = f"{camera.tiles_across:g} places the camera inside the {surface.name}"
        raise UsageError(what, where="--tiles-across", hint=f"give more than {least:g}")


def note_fine_pixels(cameras: Sequence[Camera], lattice: Lattice, console: Console) -> None:
    """Say it if pixels are smaller than the texels of the finest level."""
    resolution = lattice.shape()[1]
    covered = min(camera.pixel_width for camera in cameras) * resolution
    if covered < _TEXEL:
        console.note(
            f"a pixel covers only {covered:.2g} texels of the resolution {resolution}: "
            "maps and data of that resolution lack such fine detail"
        )


def _picture_bytes(job: Job, view: ViewSection) -> int:
    return view.size**2 * (row_bytes(job.material.transmits) + PNG_BYTES)


def render_missing(
    folder: OutputFolder,
    job: Job,
    view: ViewSection,
    kinds: Sequence[PixelKind],
    console: Console,
    advance: Callable[[float], None],
    cluster: str | None = None,
    surface: Chart | DisplacedMesh | None = None,
) -> list[str]:
    """Render the pictures of :func:`picture_names` that a folder lacks, as EXR images, and record their
    noise and brightness; returns their names. `advance` is called with pictures done, and parts of them.

    Raises
    ------
    InputError : a finished picture has changed
    PartialError : a picture failed; the same command renders the missing ones
    """
    names = picture_names(view, kinds, surface)
    omega_i = from_angles(view.light.elevation, view.light.azimuth)
    cameras = cameras_of(view)
    missing = {key: name for key, name in names.items() if folder.finished(name) is None}
    advance(len(names) - len(missing))
    items = [
        Item(
            name,
            {
                **{"source": job, "camera": camera, "omega_i": omega_i},
                **({"displaced": surface.mesh} if surface else {"kind": kind}),
                **{"spp": view.spp, "seed": job.config.seed, "index": cameras.index(camera)},
            },
        )
        for (camera, kind), name in missing.items()
    ]
    with open_runner(cluster if missing else None, console.note) as runner:
        counts_paths = bool(runner.here and missing) and surface is None
        if counts_paths:
            picture_estimator(job).observe = lambda paths: advance(paths / (view.size**2 * view.spp))
        for done in runner.map(render_shape if surface else render_reference, items):
            if done.error:
                hint = "the same command renders the missing pictures"
                raise PartialError(f"picture {done.name} failed: {done.error}", hint=hint)
            image = done.value
            noise = pooled_relative_error(image.value_a.reshape(-1, 3), image.value_b.reshape(-1, 3))
            # Without light there is no noise.
            relative = noise.value if image.value.any() else 0.0
            facts = {"relative_noise": relative, "brightness": brightness(image.value)}
            folder.keep(done.name, [image.write(folder.path / done.name)], facts)
            advance(0 if counts_paths else 1)
    return list(missing.values())


def render_references(
    config: ReferenceConfig,
    output: Path,
    console: Console,
    *,
    cluster: str | None = None,
    overwrite: bool = False,
) -> None:
    """Render the missing pictures of a folder, show all at one exposure, and report them; errors as of
    :func:`check_view` and :func:`render_missing`, and for a folder that holds something else."""
    wanted, job = config.reference, Job.load(config)
    inputs, surface = dict(job.material.digests), _surface(wanted, job.material.aspect)
    if surface is not None:
        wanted = wanted.framed(surface.radius)
        job = replace(job, config=job.config.model_copy(update={"reference": wanted}))
    if isinstance(surface, DisplacedMesh):
        inputs["surface"] = file_sha256(Path(wanted.surface))
    job.announce_briefly()
    kinds: tuple[PixelKind, ...] = ("query", "pixel") if wanted.kind == "both" else (wanted.kind,)
    if surface is not None:
        kinds = ("pixel",)
    names = picture_names(wanted, kinds, surface)
    check_view(job, wanted, output, len(kinds), surface)
    note_fine_pixels(cameras_of(wanted), job.lattice, console)
    keep_on_interruption(f"the finished pictures are kept in {output}")
    with (
        owned(output),
        console.progress(total=len(names), label="rendering", unit="pictures") as bar,
    ):
        folder = claim_pictures(
            output,
            "mbtf-gen reference",
            files=[f"{name}.{suffix}" for name in names.values() for suffix in ("exr", "png")],
            config=job.config.model_dump(mode="json", exclude={"queries", "output"}),
            inputs=inputs,
            overwrite=overwrite,
        )
        rendered = render_missing(folder, job, wanted, kinds, console, bar.advance, cluster, surface)
        known = {name: folder.finished(name) or {} for name in names.values()}
        exposure = chosen_exposure(config.exposure, [facts["brightness"] for facts in known.values()])
        for name in known:
            if folder.finished(f"{name}.png", exposure=exposure) is None:
                png = write_display(folder.path / name, read_value(folder.path / f"{name}.exr"), exposure)
                folder.keep(f"{name}.png", [png], {"exposure": exposure})
    pictures = [
        {
            "file": output / f"{name}.exr",
            "kind": kind,
            "tiles_across": camera.tiles_across,
            "relative_noise": known[name]["relative_noise"],
            "kept": name not in rendered,
        }
        for (camera, kind), name in names.items()
    ]
    lines = [
        f"{p['file']}: noise {p['relative_noise']:.2%} of the mean value{' (kept)' if p['kept'] else ''}"
        for p in pictures
    ]
    text = "\n".join([*lines, f"PNG: {describe_exposure(exposure)}"])
    console.report({"pictures": pictures, "exposure": exposure}, text)
