"""``mbtf-gen MATERIAL``: generate a data set."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from mbtf_core.console import CONSOLE, Console, resumable
from mbtf_core.errors import UsageError
from mbtf_core.options import Options, Output, Overwrite, takes_options
from mbtf_core.units import clock
from mbtf_gen.cli.common import resolve_config
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.config.presets import GENERATOR, QualityOption, as_assignments

_SPLIT_WORDS = {"train": "training"}


def _slice(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)/(\d+)", text.strip())
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise UsageError(f"'{text}' must be i/n with 1 <= i <= n, such as 3/8", where="--slice")
    return int(match[1]), int(match[2])


@takes_options(GeneratorConfig)
def generate(
    material: str | None = None,
    /,
    *,
    output: Output = Path("shards"),
    quality: QualityOption = None,
    options: Options[GeneratorConfig],
    slice: Annotated[str, Parameter(metavar="I/N")] = "1/1",
    overwrite: Overwrite = False,
    console: Console = CONSOLE,
) -> None:
    """Generate a data set: mbtf-gen heightfield.exr --queries 400/texel -o shards/

    The same command again resumes an unfinished data set.

    Parameters
    ----------
    material
        Height map, folder of maps, or material.yaml.
    slice
        Render only every n-th shard, from the i-th; finish with mbtf-gen merge.
    """
    resolved = resolve_config(options, material, as_assignments(GENERATOR[quality] if quality else {}))
    part = _slice(slice)
    from mbtf_gen.dataset.summary import summary_dict
    from mbtf_gen.generation import generate, paths_left
    from mbtf_gen.job import Job, split_queries

    job = Job.prepare(resolved)
    console.note(
        f"{resolved.material} -> {output}: {split_queries(job, 'train')} training + "
        f"{split_queries(job, 'test')} test queries, resolution {job.lattice.shape()[1]}"
    )
    total = paths_left(job, output, *part)
    with (
        resumable(f"the shards that are finished are kept in {output}"),
        console.progress(total=total, label="generating", unit="paths") as bar,
    ):
        summary = generate(
            job,
            output,
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
            (summary.nonfinite, "non-finite samples (sampled again)"),
            (summary.lost, "rays passed through the surface at a crease (counted as black)"),
            (summary.capped, "rays ended at the limit on tile crossings"),
        )
        if n
    ]
    return "\n".join([*lines, f"  noted: {', '.join(odd)}"] if odd else lines)
