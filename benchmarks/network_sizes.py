"""Networks of several sizes, trained equally long on the same data.

    python benchmarks/network_sizes.py [MATERIAL] [--quality high] [--time 4min] [--size 40x12 ...]

MATERIAL names one of ``assets/`` or a texture set that lies beside the project. The data set is that of a
quality preset. Each size, features of the hidden layers by channels of the textures, is fitted with the other
options of the presets. Prints the unexplained variance of the same test queries, milliseconds for a 1080p
image, and bytes of the material.

The last line is one JSON object with the figures and the threshold: no size that evaluates faster than the
preset's is significantly better than it. Exit code 1 where one is.
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

from mbtf_core.errors import MbtfError
from mbtf_core.nested import nested
from mbtf_core.units import parse_duration
from mbtf_fit.presets import best_options
from mbtf_gen.config.generator import count_queries
from mbtf_gen.config.presets import Quality
from mbtf_gen.generation import Job
from mbtf_gen.render.runtime import load_mitsuba
from mbtf_pipeline.cost.runs import DataRequest, Run, RunRunner
from mbtf_pipeline.run_folder import machine

SIZES = ((25, 7), (40, 12), (64, 16), (96, 24))
# Standard errors of a significant difference.
SIGNIFICANT = 2.0
# Relative standard deviation of such fits over seeds, as `mbtf-pipeline cost` measures it with millions of
# queries.
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
    data = DataRequest(count, config.queries.spp)
    runner = RunRunner(config, work, "", lambda note: print(note, file=sys.stderr))
    rows = []
    for width, channels in sizes:
        size = f"{width}x{channels}"
        network = {"network.width": width, "network.channels": channels}
        options = {**best_options(seconds, "neumip"), **network, "training.time": f"{seconds:g}s"}
        fit = nested({"model": "neumip", **options})
        found = runner.measure(Run("models", "neumip", size, data, fit))
        size_bytes = found.details["bytes"]
        evaluation = found.details["evaluation_ms_1080p"]
        rows.append(
            {
                "size": size,
                "unexplained": found.error.value,
                "error": found.error.error,
                "seconds": found.details["training_seconds"],
                "evaluation_ms_1080p": evaluation,
                "bytes": size_bytes,
            }
        )
        print(
            f"{name} {size:7s} unexplained {found.error}   "
            f"{evaluation:.0f} ms for 1080p   {size_bytes / 1e6:.2f} MB",
            flush=True,
        )
    runner.clear()
    return rows


def significantly_better(rows: list[dict[str, Any]], chosen: str) -> list[str]:
    """Sizes that evaluate faster than the chosen one and have a significantly lower or an undefined error."""
    mine = next(row for row in rows if row["size"] == chosen)

    def total_error(row: dict[str, Any]) -> float:
        return math.hypot(row["error"], SEEDS * row["unexplained"])

    return [
        row["size"]
        for row in rows
        if row["evaluation_ms_1080p"] < mine["evaluation_ms_1080p"]
        # Not so of NaN either.
        and not mine["unexplained"] - row["unexplained"]
        <= SIGNIFICANT * math.hypot(total_error(mine), total_error(row))
    ]


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("material", nargs="?", default="turtle_shell", help="an asset or a texture set")
    parser.add_argument("--quality", default="high", choices=get_args(Quality), help="of the data")
    parser.add_argument("--time", default="4min", help="training of each fit")
    parser.add_argument("--size", action="append", type=size_of, help="WIDTHxCHANNELS (repeatable)")
    parser.add_argument("--levels", type=int, default=7, help="finest level: 2^levels texels")
    arguments = parser.parse_args()
    try:
        load_mitsuba()
        seconds = parse_duration(arguments.time)
        best = best_options(seconds, "neumip")
        chosen = (best["network.width"], best["network.channels"])
        # The others are compared with the chosen one, so it is always measured.
        sizes = list(dict.fromkeys([*(arguments.size or SIZES), chosen]))
        with tempfile.TemporaryDirectory() as work:
            rows = measure(
                arguments.material, arguments.quality, seconds, sizes, arguments.levels, Path(work)
            )
    except (MbtfError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code if isinstance(error, MbtfError) else 2
    better = significantly_better(rows, "{}x{}".format(*chosen))
    print(
        json.dumps(
            {
                "figures": rows,
                "chosen": chosen,
                "thresholds": {"significantly_better_and_faster": []},
                "met": not better,
                "machine": machine(),
            }
        )
    )
    return 1 if better else 0


if __name__ == "__main__":
    sys.exit(main())
