"""``mbtf-gen reference``: reference pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from mbtf_core.console import CONSOLE, Console
from mbtf_core.shard_schema import Tiling
from mbtf_gen.cli.common import Output, Set, angles, general, numbers, resolve_config


def reference(
    material: str | None = None,
    /,
    *,
    output: Output = None,
    view: str | None = None,
    light: str | None = None,
    tiles_across: str | None = None,
    size: int | None = None,
    spp: int | None = None,
    kind: Literal["query", "pixel", "both"] | None = None,
    height_scale: float | None = None,
    mesh: int | None = None,
    make_tileable: Tiling | None = None,
    light_width: float | None = None,
    max_depth: int | None = None,
    seed: int | None = None,
    config: Path | None = None,
    assignments: Set | None = None,
    overwrite: Annotated[bool, Parameter(negative="")] = False,
    console: Console = CONSOLE,
) -> None:
    """Render reference pictures of the micro-geometry on the plane: EXR with both halves, and PNG.

    The same command again makes the pictures that are missing.

    Parameters
    ----------
    material
        Height map, folder of maps, or material.yaml.
    output
        Folder of pictures. Default: reference/
    view
        ELEVATION,AZIMUTH of the camera in degrees. Default: 60,-90
    light
        ELEVATION,AZIMUTH of the light in degrees. Default: 45,45
    tiles_across
        Widths of the field of view in tile widths, comma-separated. Default: 1,2,4
    size
        Pixels along each side. Default: 256
    spp
        Paths per pixel, both halves together (even). Default: 256
    kind
        query: M at each pixel's footprint; pixel: the truly filtered image. Default: both
    height_scale
        Factor on the stored heights, in tile widths. Default: the material's own
    mesh
        Mesh cells across the tile. Default: the map's width, at most 512
    make_tileable
        For maps that do not tile: 2 x 2 mirrored copies, or cross-faded edges. Default: none
    light_width
        RMS angle of the light per axis in degrees; 0 is a delta light. Default: 1
    max_depth
        Surface interactions per path; 0: no limit. Default: 0
    seed
        Root seed. Default: 0
    config
        YAML file with the options.
    overwrite
        Replace pictures of another configuration.
    """
    flags = {
        "--view": ("reference.view", angles(view, "--view")),
        "--light": ("reference.light", angles(light, "--light")),
        "--tiles-across": ("reference.tiles_across", numbers(tiles_across, "--tiles-across")),
        "--size": ("reference.size", size),
        "--spp": ("reference.spp", spp),
        "--kind": ("reference.kind", kind),
        **general(
            height_scale=height_scale,
            mesh=mesh,
            make_tileable=make_tileable,
            light_width=light_width,
            max_depth=max_depth,
            seed=seed,
        ),
    }
    from mbtf_gen.config.pictures import ReferenceConfig, without_queries

    resolved = resolve_config(ReferenceConfig, material, config, assignments or [], flags)
    from mbtf_core.directions import from_angles
    from mbtf_core.stats import pooled_relative_error
    from mbtf_gen.job import Job
    from mbtf_gen.pictures.camera import Camera, PixelKind
    from mbtf_gen.pictures.folder import PictureFolder
    from mbtf_gen.pictures.reference import auto_exposure, render_reference
    from mbtf_gen.planning.effects_plan import reference_plan
    from mbtf_gen.planning.simulation import build_estimator

    wanted = resolved.reference
    job = Job.prepare(resolved)
    cameras = [
        Camera(
            wanted.view.elevation, wanted.view.azimuth, tiles_across, rows=wanted.size, columns=wanted.size
        )
        for tiles_across in wanted.tiles_across
    ]
    omega_i = from_angles(wanted.light.elevation, wanted.light.azimuth)
    for camera in cameras:
        camera.queries(omega_i)  # refuses a view of the horizon before anything is written
    kinds: tuple[PixelKind, ...] = ("query", "pixel") if wanted.kind == "both" else (wanted.kind,)
    names = {(camera, one): f"{one}-tiles{camera.tiles_across:g}" for camera in cameras for one in kinds}
    folder = PictureFolder.claim(
        output or Path("reference"),
        "reference",
        files=[f"{name}.{suffix}" for name in names.values() for suffix in ("exr", "png")],
        config=without_queries(resolved),
        inputs=job.material.digests,
        overwrite=overwrite,
    )
    estimator: Any = None
    pictures: list[dict[str, Any]] = []
    exposure: float | None = None
    with console.progress(total=len(cameras) * len(kinds), label="rendering", unit="pictures") as bar:
        for index, camera in enumerate(cameras):
            for one in kinds:
                name = names[camera, one]
                facts = folder.finished(name)
                kept = facts is not None
                if facts is None:
                    estimator = estimator or build_estimator(job, reference_plan(job))
                    image = render_reference(
                        estimator, camera, omega_i, kind=one, spp=wanted.spp, seed=resolved.seed, index=index
                    )
                    exposure = exposure or auto_exposure(image.value)
                    noise = pooled_relative_error(image.value_a.reshape(-1, 3), image.value_b.reshape(-1, 3))
                    facts = {"relative_noise": noise.value, "exposure": exposure}
                    folder.keep(name, image.write(folder.path / name, exposure), facts)
                # One exposure for all: that of the first picture.
                exposure = facts["exposure"]
                pictures.append(
                    {
                        "file": folder.path / f"{name}.exr",
                        "kind": one,
                        "tiles_across": camera.tiles_across,
                        "relative_noise": facts["relative_noise"],
                        "kept": kept,
                    }
                )
                bar.advance(1)
    text = "\n".join(
        f"{p['file']}: noise {p['relative_noise']:.2%} of the mean value{' (was there)' if p['kept'] else ''}"
        for p in pictures
    )
    console.report({"pictures": pictures, "exposure": exposure}, text)
