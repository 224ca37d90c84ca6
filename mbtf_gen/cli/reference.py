"""``mbtf-gen reference``: reference pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import ClusterOption, Options, Output, Overwrite, PathText, options_from
from mbtf_core.errors import PartialError
from mbtf_core.run.signals import keep_on_interruption
from mbtf_gen.cli.generate import resolve_config
from mbtf_gen.config.pictures import RENDERING, ReferenceConfig


@options_from(ReferenceConfig, "reference", "exposure", *RENDERING)
class ReferenceOptions(Options[ReferenceConfig]):
    """Options of ``mbtf-gen reference``."""


def reference(
    material: PathText | None = None,
    /,
    *,
    output: Output = Path("reference"),
    options: ReferenceOptions = ReferenceOptions(),  # noqa: B008
    cluster: ClusterOption = None,
    overwrite: Overwrite = False,
    console: Console = CONSOLE,
) -> None:
    """Render reference pictures of the micro-geometry on the plane: EXR with two estimates, and PNG.

    The same command again renders the missing pictures. All pictures have one exposure. Another --exposure
    renders nothing again.

    Parameters
    ----------
    material
        Height map, folder of maps, material.yaml, mesh, or file of yarns or fibers.
    """
    resolved = resolve_config(options, material)
    from mbtf_core.color import auto_exposure, brightness, describe_exposure
    from mbtf_core.data.shard_files import row_bytes
    from mbtf_core.directions import from_angles
    from mbtf_core.files.folders import check_space, owned
    from mbtf_core.pictures import PNG_BYTES, Camera, PixelKind, claim_pictures, read_value, write_display
    from mbtf_core.run.cluster import open_runner
    from mbtf_core.run.task import Item
    from mbtf_core.stats import pooled_relative_error
    from mbtf_gen.forecast import announce
    from mbtf_gen.job import Job
    from mbtf_gen.pictures.reference import picture_seconds
    from mbtf_gen.pictures.tasks import picture_estimator, render_picture

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
    size = len(names) * wanted.size**2 * (row_bytes(job.material.transmits) + PNG_BYTES)
    check_space(output, size, "reduce --size, or choose another folder with -o")
    pictures: list[dict[str, Any]] = []
    bright: list[float] = []
    keep_on_interruption(f"the finished pictures are kept in {output}")
    with (
        owned(output),
        console.progress(total=len(cameras) * len(kinds), label="rendering", unit="pictures") as bar,
    ):
        folder = claim_pictures(
            output,
            "mbtf-gen reference",
            files=[f"{name}.{suffix}" for name in names.values() for suffix in ("exr", "png")],
            config=job.config.model_dump(mode="json", exclude={"queries", "output"}),
            inputs=job.material.digests,
            overwrite=overwrite,
        )
        missing = {key: name for key, name in names.items() if folder.finished(name) is None}
        items = [
            Item(
                name,
                {
                    "job": job,
                    "camera": camera,
                    "omega_i": omega_i,
                    "kind": one,
                    "spp": wanted.spp,
                    "seed": resolved.seed,
                    "index": cameras.index(camera),
                },
            )
            for (camera, one), name in missing.items()
        ]
        bar.advance(len(names) - len(missing))
        with open_runner(cluster if missing else None, console.note) as runner:
            if runner.here and missing:
                paths = sum(camera.rows * camera.columns for camera, _ in missing) * wanted.spp
                estimator = picture_estimator(job)
                announce(console, paths, lambda: picture_seconds(estimator, cameras[0], omega_i, paths), size)
            for done in runner.map(render_picture, items):
                if done.error:
                    hint = "the same command renders the missing pictures"
                    raise PartialError(f"picture {done.name} failed: {done.error}", hint=hint)
                name, image = done.name, done.value
                noise = pooled_relative_error(image.value_a.reshape(-1, 3), image.value_b.reshape(-1, 3))
                facts = {"relative_noise": noise.value, "brightness": brightness(image.value)}
                folder.keep(name, [image.write(folder.path / name)], facts)
                bar.advance(1)
        for (camera, one), name in names.items():
            known = folder.finished(name)
            assert known is not None
            bright.append(known["brightness"])
            pictures.append(
                {
                    "file": folder.path / f"{name}.exr",
                    "kind": one,
                    "tiles_across": camera.tiles_across,
                    "relative_noise": known["relative_noise"],
                    "kept": (camera, one) not in missing,
                }
            )
    exposure = auto_exposure(bright) if resolved.exposure is None else resolved.exposure
    for name in names.values():
        if folder.finished(f"{name}.png") != {"exposure": exposure}:
            png = write_display(folder.path / name, read_value(folder.path / f"{name}.exr"), exposure)
            folder.keep(f"{name}.png", [png], {"exposure": exposure})
    lines = [
        f"{p['file']}: noise {p['relative_noise']:.2%} of the mean value{' (kept)' if p['kept'] else ''}"
        for p in pictures
    ]
    text = "\n".join([*lines, f"PNG: {describe_exposure(exposure)}"])
    console.report({"pictures": pictures, "exposure": exposure}, text)
