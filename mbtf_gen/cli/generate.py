"""``mbtf-gen MATERIAL``: generate a data set."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from cyclopts import Parameter

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import (
    MORE,
    ClusterOption,
    DataOutput,
    Options,
    Overwrite,
    PathText,
    Quality,
    QualityOption,
    options_from,
)
from mbtf_core.errors import UsageError
from mbtf_core.run.signals import keep_on_interruption
from mbtf_core.units import clock, rate_text, size_text
from mbtf_gen.config.generator import RESOLUTION, GeneratorConfig, generator_options

if TYPE_CHECKING:
    from mbtf_gen.generation.manifest import Summary
    from mbtf_gen.planning.job import Job

G = TypeVar("G", bound=GeneratorConfig)


SMALLER = "reduce --queries or --resolution, or choose another folder with -o"


def resolve_config(options: Options[G], material: str | None, presets: Mapping[str, Any] | None = None) -> G:
    """Configuration that a command line asks for.

    Raises
    ------
    UsageError : no material, or a flag or an assignment is at fault
    InputError : the file is at fault
    """
    if material is None and options.config is None:
        raise UsageError("no material given", hint="mbtf-gen heightfield.exr --queries 400/texel -o shards/")
    return options.resolve(presets, material=material)


def prepare_job(
    options: Options[GeneratorConfig], material: str | None, quality: Quality | None = None
) -> Job:
    """The data set that a command line asks for, with its material loaded; errors as :func:`resolve_config`
    and of the material."""
    from mbtf_gen.planning.job import Job, limit_resolution

    preset = generator_options(quality, options.explicit())
    job = Job.load(resolve_config(options, material, preset))
    return limit_resolution(job) if RESOLUTION in preset else job


def _slice(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)/(\d+)", text.strip())
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise UsageError(f"'{text}' must be i/n with 1 <= i <= n, such as 3/8", where="--slice")
    return int(match[1]), int(match[2])


@options_from(GeneratorConfig)
class GenerateOptions(Options[GeneratorConfig]):
    """Options of ``mbtf-gen``."""


def generate(
    material: PathText | None = None,
    /,
    *,
    output: DataOutput = Path("shards"),
    quality: QualityOption = None,
    options: GenerateOptions = GenerateOptions(),  # noqa: B008
    slice: Annotated[str, Parameter(metavar="I/N", group=MORE)] = "1/1",
    cluster: ClusterOption = None,
    overwrite: Overwrite = False,
    console: Console = CONSOLE,
) -> None:
    """Generate a data set: mbtf-gen heightfield.exr --queries 400/texel -o shards/

    The same command again resumes an unfinished data set.

    Parameters
    ----------
    material
        Height map, folder of maps, material.yaml, mesh, yarns or fibers.
    slice
        Render only every n-th shard, from the i-th; finish with mbtf-gen merge.
    """
    index, count = _slice(slice)
    job = prepare_job(options, material, quality)
    from mbtf_core.data.folder import DataFolder
    from mbtf_core.files.folders import check_space
    from mbtf_core.run.cluster import open_runner
    from mbtf_gen.generation.run import generate, unfinished
    from mbtf_gen.planning.job import data_bytes, split_queries

    folder = DataFolder.open(output)
    left = unfinished(job, folder, index, count, overwrite)
    if left:
        job.announce()
    size = data_bytes(job, left)
    console.note(
        f"{job.config.material} -> {folder}: {split_queries(job, 'train')} training + "
        f"{split_queries(job, 'test')} test queries, resolution {job.lattice.shape()[1]}, {size_text(size)}"
    )
    if folder.local is not None:
        check_space(folder.local, size, SMALLER)

    keep_on_interruption(f"the shards that are finished are kept in {folder}")
    # Without anything to render, no workers are started.
    with (
        open_runner(cluster if left else None, console.note) as runner,
        console.progress(None, "generating", "paths") as bar,
    ):
        summary = generate(
            job,
            folder,
            overwrite=overwrite,
            slice_index=index,
            slice_count=count,
            progress=bar.update,
            runner=runner,
        )
    console.report(asdict(summary), describe(summary))
    if left and (warning := job.material.scale_warning()) is not None:
        console.note(f"warning: {warning}")


def describe(summary: Summary, *, ran: bool = True) -> str:
    """What a folder of shards holds and, where it `ran`, what the run added."""
    state = "complete" if summary.complete else "unfinished: run the other slices, then mbtf-gen merge"
    counts = " + ".join(f"{n} {'training' if k == 'train' else k}" for k, n in summary.splits.items())
    lines = [f"{summary.folder}: {counts} queries, {state}"]
    if summary.measured or summary.relative_error is None:
        # Measured values are not traced.
        lines.append(
            f"  mean value {sum(summary.mean_value) / 3:.4g} 1/sr; one value per query: its noise is unknown"
        )
        return "\n".join(lines)
    if ran and summary.paths:
        lines.append(
            f"  this run: {summary.paths} paths in {clock(summary.seconds)} with start-up "
            f"({rate_text(summary.paths_per_second)})"
        )
    elif ran:
        lines.append("  this run: nothing left to do")
    noise = f"pooled noise of a training query {summary.relative_error:.1%} of the mean"
    if summary.complete and summary.relative_error > 0:
        # The variance of every value falls at least like one over the number of paths.
        more = clock(3.0 * summary.shard_seconds)
        noise += f"; halving it would take about {more} more (four times the paths)"
    lines.append(f"  mean value {sum(summary.mean_value) / 3:.4g} 1/sr, {noise}")
    if target := summary.target:
        line = f"  error of a training value: {target['reached']:.2%} of max(value, tile mean), RMS"
        if target["missed"]:
            line += f"; {target['missed']} queries ({target['share']:.2%}) stopped at the cap"
            line += f", the worst at {target['worst']:.1%}"
        lines.append(line)
    lines.append(f"  simulated: {', '.join(summary.effects) or 'nothing beyond a flat Lambert plane'}")
    noted = {
        "non-finite samples (sampled again)": summary.nonfinite,
        "rays passed through the surface at a crease (counted as black)": summary.lost,
        "rays ended at the limit on tile crossings": summary.capped,
    }
    if any(noted.values()):
        lines.append(f"  noted: {', '.join(f'{n} {what}' for what, n in noted.items() if n)}")
    return "\n".join(lines)
