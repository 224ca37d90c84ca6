"""``mbtf-gen reference``: reference pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from ..console import CONSOLE, Console
from ..errors import UsageError
from .common import Output, Set, angles, resolve_config


def reference(
    material: str | None = None,
    /,
    *,
    output: Output = None,
    view: str = "60,-90",
    light: str = "45,45",
    zooms: str = "1,2,4",
    size: int = 256,
    spp: int = 256,
    kind: Literal["query", "pixel", "both"] = "both",
    height: float | None = None,
    mesh: int | None = None,
    light_width: float | None = None,
    max_depth: int | None = None,
    seed: int | None = None,
    config: Path | None = None,
    assignments: Set | None = None,
    console: Console = CONSOLE,
) -> None:
    """Render reference pictures of the micro-geometry on the plane: EXR with both halves, and PNG.

    Parameters
    ----------
    material
        Height map, folder of maps, or material.yaml.
    output
        Folder of pictures. Default: reference/
    view
        ELEVATION,AZIMUTH of the camera in degrees.
    light
        ELEVATION,AZIMUTH of the light in degrees.
    zooms
        Widths of the field of view in tile widths, comma-separated.
    size
        Pixels along each side.
    spp
        Paths per pixel, both halves together (even).
    kind
        query: M at each pixel's footprint; pixel: the truly filtered image.
    height
        Factor on the stored heights, in tile widths.
    mesh
        Mesh cells across the tile.
    light_width
        RMS angle of the light per axis in degrees; 0 is a delta light.
    max_depth
        Surface interactions per path; 0: no limit.
    seed
        Root seed.
    config
        YAML file with the options.
    """
    elevation, azimuth = angles(view, "--view")
    towards = angles(light, "--light")
    try:
        spans = [float(z) for z in zooms.split(",")]
    except ValueError:
        raise UsageError(f"'{zooms}' must be numbers separated by commas", where="--zooms") from None
    if not spans or min(spans) <= 0:
        raise UsageError("field widths must be positive", where="--zooms")
    if spp < 2 or spp % 2:
        raise UsageError(f"{spp} must be even and at least 2", where="--spp")
    if not 1 <= size <= 16384:
        raise UsageError(f"{size} must lie in 1..16384", where="--size")
    flags = {
        "geometry.height": height,
        "geometry.mesh": mesh,
        "light.width": light_width,
        "transport.max_depth": max_depth,
        "seed": seed,
    }
    resolved = resolve_config(material, config, assignments or [], flags)
    from ..camera import Camera, PixelKind
    from ..directions import from_angles
    from ..generation import Job, build_estimator
    from ..reference import auto_exposure, render_reference
    from ..stats import pooled_relative_error

    folder = output or Path("reference")
    job = Job.prepare(resolved)
    cameras = [Camera(elevation, azimuth, span, rows=size, columns=size) for span in spans]
    omega_i = from_angles(*towards)
    for camera in cameras:
        camera.queries(omega_i)
    folder.mkdir(parents=True, exist_ok=True)
    kinds: tuple[PixelKind, ...] = ("query", "pixel") if kind == "both" else (kind,)
    estimator = build_estimator(resolved, job.material)
    pictures: list[dict[str, Any]] = []
    exposure: float | None = None
    with console.progress(total=len(cameras) * len(kinds), label="rendering", unit="pictures") as bar:
        for index, camera in enumerate(cameras):
            for one in kinds:
                image = render_reference(
                    estimator, camera, omega_i, kind=one, spp=spp, seed=resolved.seed, index=index
                )
                exposure = auto_exposure(image.value) if exposure is None else exposure
                path = folder / f"{one}-span{camera.span:g}"
                image.write(path, exposure)
                noise = pooled_relative_error(image.value_a.reshape(-1, 3), image.value_b.reshape(-1, 3))
                pictures.append(
                    {
                        "file": path.with_name(f"{path.name}.exr"),
                        "kind": one,
                        "span": camera.span,
                        "relative_noise": noise.value,
                    }
                )
                bar.advance(1)
    text = "\n".join(f"{p['file']}: noise {p['relative_noise']:.2%} of the mean value" for p in pictures)
    console.report({"pictures": pictures, "exposure": exposure}, text)
