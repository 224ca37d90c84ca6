"""Command line of ``mbtf-gen``."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from .console import CONSOLE, Console, clock, new_app
from .errors import EXIT_BAD_INPUT, EXIT_OK, UsageError

app = new_app("mbtf-gen", "Generate multi-resolution BTF (MBTF) data sets from displaced materials.")

Set = Annotated[
    list[str], Parameter(name="--set", help="Set any option of the configuration, a.b=c. Repeatable.")
]
Output = Annotated[Path | None, Parameter(name=["--output", "-o"])]


def _resolve(material: str | None, config: Path | None, assignments: list[str], flags: dict[str, Any]) -> Any:
    from .config import GeneratorConfig, check_queries_flag
    from .settings import resolve

    check_queries_flag(flags.get("queries.train"), "--queries")
    check_queries_flag(flags.get("queries.test"), "--test-queries")
    if material is None and config is None:
        raise UsageError("no material given", cure="mbtf-gen heightfield.exr --queries 400/texel -o shards/")
    resolved = resolve(
        GeneratorConfig, file=config, assignments=assignments, flags={"material": material, **flags}
    )
    if material is None and config is not None and not Path(resolved.material).is_absolute():
        # A path in a file is relative to that file, so that the file works from anywhere.
        resolved = resolved.model_copy(update={"material": str(config.parent / resolved.material)})
    return resolved


def _slice(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)/(\d+)", text.strip())
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise UsageError(f"'{text}' must be i/n with 1 <= i <= n, such as 3/8", where="--shards")
    return int(match[1]), int(match[2])


@app.default
def generate(
    material: str | None = None,
    /,
    *,
    output: Output = None,
    queries: str | None = None,
    test_queries: str | None = None,
    spp: int | None = None,
    test_spp: int | None = None,
    height: float | None = None,
    mesh: int | None = None,
    levels: int | None = None,
    light_width: float | None = None,
    min_cos: float | None = None,
    max_depth: int | None = None,
    layout: Literal["shuffled", "image"] | None = None,
    format: Literal["npz", "exr"] | None = None,
    seed: int | None = None,
    shards: str = "1/1",
    config: Path | None = None,
    assignments: Set | None = None,
    overwrite: Annotated[bool, Parameter(negative="")] = False,
    console: Console = CONSOLE,
) -> None:
    """Generate a data set: mbtf-gen heightfield.exr --queries 400/texel -o shards/

    The same command again resumes an unfinished data set.

    Parameters
    ----------
    material
        Height map, folder of maps, or material.yaml.
    output
        Folder of shards. Default: shards/
    queries
        Training queries: N, or N/texel of the finest level. Default: 100/texel
    test_queries
        Test queries: N or N/texel. Default: 8192
    spp
        Paths per training query, both halves together (even). Default: 4
    test_spp
        Paths per test query, both halves together (even). Default: 256
    height
        Factor on the stored heights, in tile widths. Default: the material's own
    mesh
        Mesh cells across the tile. Default: the map's width, at most 512
    levels
        Finest level k: 2^k texels across. Default: from the map's width
    light_width
        RMS angle of the light per axis in degrees; 0 is a delta light. Default: 1
    min_cos
        Smallest cosine of light and view directions to the normal. Default: 0.1
    max_depth
        Surface interactions per path; 0: no limit (Russian roulette). Default: 0
    layout
        shuffled queries, or one image buffer per (light, view, footprint).
    format
        npz or exr shards.
    seed
        Root seed. Default: 0
    shards
        Slice i/n: make only every n-th shard; finish with mbtf-gen merge.
    config
        YAML file with the options.
    overwrite
        Replace a data set of another configuration.
    """
    flags = {
        "queries.train": queries,
        "queries.test": test_queries,
        "queries.spp": spp,
        "queries.test_spp": test_spp,
        "queries.levels": levels,
        "queries.min_cos": min_cos,
        "queries.layout": layout,
        "geometry.height": height,
        "geometry.mesh": mesh,
        "light.width": light_width,
        "transport.max_depth": max_depth,
        "output.format": format,
        "seed": seed,
    }
    resolved = _resolve(material, config, assignments or [], flags)
    part = _slice(shards)
    from .generation import Job, generate, summary_dict

    folder = output or Path("shards")
    job = Job.prepare(resolved)
    per_row = job.lattice.texels() if resolved.queries.layout == "image" else 1
    total = sum(e.rows * per_row for split in ("train", "test") for e in job.shards(split))
    console.note(f"{resolved.material} -> {folder}: {total} queries, level {job.lattice.finest}")
    with console.progress(total=total, label="generating", unit="queries") as bar:
        summary = generate(
            resolved,
            folder,
            overwrite=overwrite,
            slice_index=part[0],
            slice_count=part[1],
            progress=lambda done, note: bar.update(done, note),
            job=job,
        )
    console.report(summary_dict(summary), _describe(summary))


def _describe(summary: Any) -> str:
    state = "complete" if summary.complete else "unfinished: run the other slices, then mbtf-gen merge"
    lines = [
        f"{summary.folder}: {summary.queries} queries, {state}",
        f"  this run: {summary.paths} paths in {clock(summary.seconds)} "
        f"({summary.paths_per_second / 1e6:.2f} M paths/s)",
        f"  mean value {sum(summary.mean_value) / 3:.4g} 1/sr, "
        f"pooled noise of a training query {summary.relative_error:.1%} of the mean",
        f"  simulated: {', '.join(summary.effects) or 'nothing beyond a flat Lambert plane'}",
    ]
    odd = [
        f"{n} {what}"
        for n, what in (
            (summary.nonfinite, "non-finite samples (drawn again)"),
            (summary.lost, "rays slipped below the surface at a crease (they bring no light)"),
            (summary.capped, "rays cut at the cap on tile crossings"),
        )
        if n
    ]
    return "\n".join([*lines, f"  noted: {', '.join(odd)}"] if odd else lines)


@app.command
def merge(folder: Path, /, *, console: Console = CONSOLE) -> int:
    """Complete the manifest of a folder that slices (--shards i/n) were written into.

    Parameters
    ----------
    folder
        Folder of shards.
    """
    from .dataset import Dataset
    from .errors import EXIT_PARTIAL
    from .generation import finish, summary_dict

    Dataset.open(folder)
    summary = finish(folder)
    console.report(summary_dict(summary), _describe(summary))
    return EXIT_OK if summary.complete else EXIT_PARTIAL


@app.command
def verify(folder: Path, /, *, console: Console = CONSOLE) -> int:
    """Check every shard of a data set against its digest and the manifest.

    Parameters
    ----------
    folder
        Folder of shards.
    """
    from .dataset import Dataset
    from .verification import verify

    faults = verify(folder)
    dataset = Dataset.open(folder)
    count = sum(len(s["shards"]) for s in dataset.manifest["splits"].values())
    text = (
        "\n".join(f"{folder / f.file}: {f.what}" for f in faults) or f"{folder}: {count} shards, all intact"
    )
    data = {"folder": folder, "shards": count, "faults": [{"file": f.file, "what": f.what} for f in faults]}
    console.report(data, text)
    return EXIT_BAD_INPUT if faults else EXIT_OK


def _angles(text: str, flag: str) -> tuple[float, float]:
    parts = text.split(",")
    try:
        elevation, azimuth = (float(p) for p in parts)
    except ValueError:
        raise UsageError(
            f"'{text}' must be ELEVATION,AZIMUTH in degrees, such as 60,-90", where=flag
        ) from None
    if not 0 < elevation <= 90:
        raise UsageError(f"elevation {elevation:g} must lie above 0 and at most at 90 degrees", where=flag)
    return elevation, azimuth


@app.command
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
    elevation, azimuth = _angles(view, "--view")
    towards = _angles(light, "--light")
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
    resolved = _resolve(material, config, assignments or [], flags)
    from .camera import Camera, PixelKind
    from .directions import from_angles
    from .generation import Job, build_estimator
    from .reference import auto_exposure, render_reference
    from .stats import pooled_relative_error

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


@app.command
def doctor(*, console: Console = CONSOLE) -> int:
    """Say what this machine has, prove each part by using it, and name the cure for what fails."""
    from .doctor import as_json, as_text, diagnose, exit_code

    checks = diagnose()
    console.report(as_json(checks), as_text(checks))
    return exit_code(checks)
