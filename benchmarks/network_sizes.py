"""Networks of several sizes, trained equally long on the same data.

    python benchmarks/network_sizes.py [MATERIAL] [--quality high] [--time 4min] [--size 40x12 ...]

Of a material (of ``assets/`` or of the texture sets that lie beside the project, by name): training data as
the quality has them, then for each size, features of the hidden layers by channels of the textures, a fit of
`neumip` as the qualities have it otherwise. Printed: unexplained variance of the same test queries,
milliseconds for a picture of 1080p, and bytes of the material.

The last line is one JSON object: figures, and the bar: no size that evaluates faster than the one which the
qualities take after so much training is clearly better than it. Exit code 1 where it is missed.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from pathlib import Path
from typing import Any, get_args

from quality import generator_config

from mbtf_core.config_file import nested
from mbtf_core.errors import MbtfError
from mbtf_core.units import parse_duration
from mbtf_fit.presets import best_options
from mbtf_gen.config.generator import count_queries
from mbtf_gen.config.presets import Quality
from mbtf_gen.job import Job
from mbtf_gen.render.runtime import load_mitsuba
from mbtf_pipeline.cost_study.runs import Chain, RunRequest, RunRunner
from mbtf_pipeline.run_folder import machine

SIZES = ((25, 7), (40, 12), (64, 16), (96, 24))
# Standard errors of a difference that make it clear.
CLEAR = 2.0
# Relative deviation of such fits between seeds, as `mbtf-pipeline cost` finds it with millions of queries.
SEEDS = 0.03


def size_of(text: str) -> tuple[int, int]:
    """(features, channels) of ``WIDTHxCHANNELS``.

    Raises
    ------
    ValueError : it is none
    """
    width, channels = (int(n) for n in text.split("x"))
    return width, channels


def measure(
    name: str, quality: Quality, seconds: float, sizes: list[tuple[int, int]], levels: int, work: Path
) -> list[dict[str, Any]]:
    """A row for each size."""
    config = generator_config(name, quality, levels)
    count = count_queries(config.queries.train, Job.prepare(config).lattice.texels())
    data = RunRequest(count, config.queries.spp)
    workshop = RunRunner(config, work, "", lambda note: print(note, file=sys.stderr))
    rows = []
    for width, channels in sizes:
        size = f"{width}x{channels}"
        network = {"network.width": width, "network.channels": channels}
        options = {**best_options(seconds), **network, "training.time": f"{seconds:g}s"}
        fit = nested({"model": "neumip", **options})
        point = workshop.measure(Chain("fit", "neumip", size, data, fit))
        size_bytes = point.details["bytes"]
        evaluation = point.details["evaluation_ms_1080p"]
        rows.append(
            {
                "size": size,
                "unexplained": point.error.value,
                "error": point.error.error,
                "seconds": point.details["training_seconds"],
                "evaluation_ms_1080p": evaluation,
                "bytes": size_bytes,
            }
        )
        print(
            f"{name} {size:7s} unexplained {point.error}   "
            f"{evaluation:.0f} ms for 1080p   {size_bytes / 1e6:.2f} MB",
            flush=True,
        )
    workshop.clear()
    return rows


def clearly_better(rows: list[dict[str, Any]], chosen: str) -> list[str]:
    """Sizes that evaluate faster than the chosen one and leave clearly less, or whose error could not be told
    from it."""
    mine = next(row for row in rows if row["size"] == chosen)

    def bar(row: dict[str, Any]) -> float:
        return math.hypot(row["error"], SEEDS * row["unexplained"])

    return [
        row["size"]
        for row in rows
        if row["evaluation_ms_1080p"] < mine["evaluation_ms_1080p"]
        # Not so of NaN either.
        and not mine["unexplained"] - row["unexplained"] <= CLEAR * math.hypot(bar(mine), bar(row))
    ]


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("material", nargs="?", default="turtle_shell", help="an asset or a texture set")
    parser.add_argument("--quality", default="high", choices=get_args(Quality), help="of the data")
    parser.add_argument("--time", default="4min", help="training of each fit")
    parser.add_argument("--size", action="append", type=size_of, help="WIDTHxCHANNELS (repeatable)")
    parser.add_argument("--resolution", type=int, default=128, help="texels across, a power of two")
    arguments = parser.parse_args()
    try:
        load_mitsuba()
        seconds = parse_duration(arguments.time)
        best = best_options(seconds)
        chosen = (best["network.width"], best["network.channels"])
        # The one that the others are held against is always among them.
        sizes = list(dict.fromkeys([*(arguments.size or SIZES), chosen]))
        with tempfile.TemporaryDirectory() as work:
            rows = measure(
                arguments.material,
                arguments.quality,
                seconds,
                sizes,
                arguments.resolution.bit_length() - 1,
                Path(work),
            )
    except (MbtfError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code if isinstance(error, MbtfError) else 2
    better = clearly_better(rows, "{}x{}".format(*chosen))
    print(
        json.dumps(
            {
                "figures": rows,
                "chosen": chosen,
                "bars": {"clearly_better_and_faster": []},
                "met": not better,
                "machine": machine(),
            }
        )
    )
    return 1 if better else 0


if __name__ == "__main__":
    sys.exit(main())
