"""Time, error and size of the quality presets: complete runs, from height map to report.

    python benchmarks/quality.py --out FOLDER [--only MATERIAL:QUALITY ...]

Runs ``mbtf-pipeline run --quality`` in a process of its own: ``draft`` on six texture sets, ``standard`` on
three of them, ``high`` on one. ``paper`` needs a GPU and is not run. ``--only`` (repeatable) selects single
runs, also of assets, such as ``turtle_shell:draft``. FOLDER keeps the figures of every finished run, so the
same command resumes. Each is printed as a row of the documentation's table. The last line is one JSON object.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
import zlib
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, get_args

from common import HEIGHT_SCALES, finish, is_available, kept, parser_of, source, start

from mbtf_core.app.options import Quality
from mbtf_core.config.settings import resolve
from mbtf_core.units import clock, parse_duration
from mbtf_fit.config import FITTER, best_options
from mbtf_gen.config.generator import GENERATOR, RESOLUTION, GeneratorConfig

# Texture sets of the longer runs.
LONGER: dict[Quality, tuple[str, ...]] = {
    "standard": ("metal_plate", "rock_cliff", "tree_bark"),
    "high": ("rock_cliff",),
}
# Seconds of a whole run.
THRESHOLDS = {"draft": 60.0, "standard": 600.0}
QUALITIES: tuple[Quality, ...] = get_args(Quality)
RECIPE = """\
name: quality
generate:
  material: {material}
  geometry: {{height_scale: {height}}}
fit: {{model: relief}}
"""


def row_of(found: Mapping[str, Any]) -> str:
    """A run as a row of the documentation's table."""
    scale = "" if found["height_scale"] is None else f", height scale {found['height_scale']:g}"
    cells = (
        f"`{found['quality']}`",
        f"{found['material']}{scale}",
        *(clock(found[name]) for name in ("seconds", "generate", "fit")),
        f"{found['unexplained']:.3f} ± {found['unexplained_error']:.3f}",
        f"{found['material_bytes'] / 1e6:.2f} MB",
    )
    return f"| {' | '.join(cells)} |"


def generator_config(name: str, quality: Quality, resolution: int, **queries: Any) -> GeneratorConfig:
    """Configuration of the generator for a material at a preset, with some options of the queries."""
    material, height = source(name)
    return resolve(
        GeneratorConfig,
        presets=GENERATOR[quality],
        flags={
            "material": str(material),
            "geometry.height_scale": height,
            "queries.resolution": resolution,
            **{f"queries.{name}": value for name, value in queries.items()},
        },
    )


def run(name: str, quality: Quality, resolution: int, work: Path) -> dict[str, Any]:
    """Run the pipeline on a material, timed from outside, in an empty folder `work`.

    Raises
    ------
    SystemExit : the run failed
    """
    material, height = source(name)
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    recipe, out = work / "recipe.yaml", work / "run"
    text = RECIPE.format(material=json.dumps(str(material)), height=json.dumps(height))
    recipe.write_text(text, encoding="utf-8")
    command = [sys.executable, "-m", "mbtf_pipeline", "run", str(recipe), "--quality", quality]
    command += ["-o", str(out), "--json", "--quiet", "--set", f"generate.{RESOLUTION}={resolution}"]
    start = time.perf_counter()
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    seconds = time.perf_counter() - start
    if done.returncode:
        raise SystemExit(f"{name} at {quality} ended with exit code {done.returncode}")
    summary = json.loads(done.stdout)
    stages = {stage: record["seconds"] for stage, record in summary["stages"].items()}
    unexplained = summary["test"]["relief"]["unexplained_variance"]
    if unexplained["value"] is None:
        raise SystemExit(f"{name} at {quality}: the unexplained variance of its test values is undefined")
    found = {
        "material": name,
        "quality": quality,
        "height_scale": height,
        "seconds": seconds,
        "generate": stages["generate"],
        "fit": sum(s for stage, s in stages.items() if stage.startswith("fit")),
        "unexplained": unexplained["value"],
        "unexplained_error": unexplained["error"],
        "material_bytes": sum(p.stat().st_size for p in (out / "fits" / "relief").glob("weights*")),
    }
    shutil.rmtree(work)
    return found


def requested(only: Sequence[str] | None) -> list[tuple[str, Quality]]:
    """(material, preset) to run.

    Raises
    ------
    SystemExit : an unknown material or preset
    """
    if not only:
        sets: dict[Quality, tuple[str, ...]] = {"draft": tuple(HEIGHT_SCALES), **LONGER}
        return [(name, quality) for quality, names in sets.items() for name in names]
    out: list[tuple[str, Quality]] = []
    for text in only:
        name, _, quality = text.partition(":")
        if quality not in QUALITIES or not source(name)[0].is_dir():
            raise SystemExit(f"--only {text}: must be MATERIAL:QUALITY, such as rock_cliff:draft")
        out.append((name, quality))
    return out


def options_of(quality: Quality) -> str:
    """Checksum of what a preset stands for: figures of an earlier one are not kept."""
    training = FITTER[quality]
    sizes = best_options(parse_duration(training.get("training.time", "1h")))
    return f"{zlib.crc32(json.dumps([GENERATOR[quality], training, sizes]).encode()):08x}"


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of the finished runs")
    parser.add_argument("--only", action="append", help="MATERIAL:QUALITY (repeatable)")
    parser.add_argument("--resolution", type=int, help="texels across; default: the preset's")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    runs = []
    for name, quality in requested(arguments.only):
        if is_available(name):
            resolution = int(arguments.resolution or GENERATOR[quality][RESOLUTION])
            path = arguments.out / f"{name}-{quality}-{resolution}-{options_of(quality)}.json"
            runs.append(kept(path, partial(run, name, quality, resolution, arguments.out / ".work")))
            print(row_of(runs[-1]), flush=True)
    timed = [r for r in runs if r["quality"] in THRESHOLDS and arguments.resolution is None]
    met = all(r["seconds"] <= THRESHOLDS[r["quality"]] for r in timed)
    return finish({"runs": runs}, THRESHOLDS, met)


if __name__ == "__main__":
    start(main)
