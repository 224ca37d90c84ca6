"""``mbtf-gen MATERIAL``: generate a data set."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from mbtf_core.console import CONSOLE, Console, clock, resumable
from mbtf_core.errors import UsageError
from mbtf_core.shard_schema import Tiling
from mbtf_gen.cli.common import Output, QualityOption, Set, general, resolve_config
from mbtf_gen.config.presets import GENERATOR, as_assignments

_SPLIT_WORDS = {"train": "training"}


def _slice(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)/(\d+)", text.strip())
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise UsageError(f"'{text}' must be i/n with 1 <= i <= n, such as 3/8", where="--slice")
    return int(match[1]), int(match[2])


def generate(
    material: str | None = None,
    /,
    *,
    output: Output = None,
    quality: QualityOption | None = None,
    queries: str | None = None,
    test_queries: str | None = None,
    spp: int | None = None,
    target_error: str | None = None,
    test_spp: int | None = None,
    height_scale: float | None = None,
    mesh: int | None = None,
    make_tileable: Tiling | None = None,
    resolution: int | None = None,
    light_width: float | None = None,
    min_cos: float | None = None,
    max_depth: int | None = None,
    effects: str | None = None,
    layout: Literal["shuffled", "image"] | None = None,
    format: Literal["npz", "exr"] | None = None,
    seed: int | None = None,
    slice: str = "1/1",
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
        Test queries, made besides the training queries: N or N/texel. Default: 8192
    spp
        Mean number of paths per training query, both halves together (even). Default: 4
    target_error
        Error of every training value relative to max(value, tile mean), such as 2%, in place of --spp.
    test_spp
        Mean number of paths per test query, both halves together (even). Default: 256
    height_scale
        Factor on the stored heights, in tile widths. Default: the material's own
    mesh
        Mesh cells across the tile. Default: the map's width, at most 512
    make_tileable
        For maps that do not tile: 2 x 2 mirrored copies, or cross-faded edges. Default: none
    resolution
        Texels across at the finest level, a power of two. Default: from the map's width
    light_width
        RMS angle of the light per axis in degrees; 0 is a delta light. Default: 1
    min_cos
        Smallest cosine of light and view directions to the normal. Default: 0.1
    max_depth
        Surface interactions per path; 0: no limit (Russian roulette). Default: 0
    effects
        auto, all, none, then +x or -x: effects of light to simulate. Default: auto
    layout
        shuffled queries, or one image per (light, view, footprint).
    format
        npz or exr shards.
    seed
        Root seed. Default: 0
    slice
        i/n: make only every n-th shard; finish with mbtf-gen merge.
    config
        YAML file with the options.
    overwrite
        Replace a data set of another configuration.
    """
    from mbtf_gen.config.generator import GeneratorConfig

    flags = {
        "--queries": ("queries.train", queries),
        "--test-queries": ("queries.test", test_queries),
        "--spp": ("queries.spp", spp),
        "--target-error": ("queries.target_error", target_error),
        "--test-spp": ("queries.test_spp", test_spp),
        "--resolution": ("queries.resolution", resolution),
        "--min-cos": ("queries.min_cos", min_cos),
        "--effects": ("effects.mode", effects),
        "--layout": ("queries.layout", layout),
        "--format": ("output.format", format),
        **general(
            height_scale=height_scale,
            mesh=mesh,
            make_tileable=make_tileable,
            light_width=light_width,
            max_depth=max_depth,
            seed=seed,
        ),
    }
    assigned = [*as_assignments(GENERATOR[quality] if quality else {}), *(assignments or [])]
    resolved = resolve_config(GeneratorConfig, material, config, assigned, flags)
    part = _slice(slice)
    from mbtf_gen.dataset.summary import summary_dict
    from mbtf_gen.generation import generate, paths_left
    from mbtf_gen.job import Job, split_queries

    folder = output or Path("shards")
    job = Job.prepare(resolved)
    console.note(
        f"{resolved.material} -> {folder}: {split_queries(job, 'train')} training + "
        f"{split_queries(job, 'test')} test queries, finest level {job.lattice.finest}"
    )
    total = paths_left(job, folder, *part)
    with (
        resumable(f"the shards that are finished are kept in {folder}"),
        console.progress(total=total, label="generating", unit="paths") as bar,
    ):
        summary = generate(
            job,
            folder,
            overwrite=overwrite,
            slice_index=part[0],
            slice_count=part[1],
            progress=bar.update,
        )
    console.report(summary_dict(summary), describe(summary))


def _target_line(summary: Any) -> list[str]:
    target = summary.target
    if target is None:
        return []
    line = f"  error of a training value: {target['reached']:.2%} of max(value, tile mean), RMS"
    if target["missed"]:
        line += (
            f"; {target['missed']} queries ({target['share']:.2%}) stopped at the cap, the worst at "
            f"{target['worst']:.1%}"
        )
    return [line]


def _price(summary: Any) -> str:
    """What halving the noise of every value would take: its variance falls at least like one over the number
    of paths."""
    if not summary.complete or summary.relative_error <= 0:
        return ""
    return f"; halving it would take about {clock(3.0 * summary.shard_seconds)} more (four times the paths)"


def describe(summary: Any, *, ran: bool = True) -> str:
    """What a folder of shards holds and, where it `ran`, what the run added."""
    state = "complete" if summary.complete else "unfinished: run the other slices, then mbtf-gen merge"
    counts = " + ".join(f"{n} {_SPLIT_WORDS.get(split, split)}" for split, n in summary.splits.items())
    work = "nothing left to do"
    if summary.paths:
        speed = f"{summary.paths_per_second / 1e6:.2f} M paths/s"
        disk = f"{summary.waiting_seconds:.1f} s of it waiting for the disk"
        work = f"{summary.paths} paths in {clock(summary.seconds)} ({speed}), {disk}"
    lines = [
        f"{summary.folder}: {counts} queries, {state}",
        *([f"  this run: {work}"] if ran else []),
        f"  mean value {sum(summary.mean_value) / 3:.4g} 1/sr, "
        f"pooled noise of a training query {summary.relative_error:.1%} of the mean{_price(summary)}",
        *_target_line(summary),
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
