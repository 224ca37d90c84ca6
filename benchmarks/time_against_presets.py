"""``mbtf-pipeline run --time`` against the quality preset that fits the same time.

    python benchmarks/time_against_presets.py [MATERIAL ...] [--time 2min] [--seeds 2] [--resolution N]
        [--out FOLDER]

For each material and seed, runs ``--time`` and then the preset that it chose, in processes of their own. Both
have the same test queries. By default six texture sets that lie beside the project; other materials are
folders of ``assets/``. FOLDER keeps the figures of finished runs, so the same command resumes.

The last line is one JSON object with the figures and their thresholds: a run under ``--time`` takes at most
1.1 times that time, and its error over that of the preset, the geometric mean over seeds, is at most 1 within
two standard errors. Exit code 1 where a threshold is exceeded. Nothing else should use the processors.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from quality import HEIGHT_SCALES, source

from mbtf_core.files.atomic import read_json, write_json
from mbtf_core.units import parse_duration

RECIPE = """\
name: timed
generate:
  material: {material}
  geometry: {{height_scale: {height}}}
  queries: {{resolution: {resolution}}}
  seed: {seed}
fit: {{model: relief, seed: {seed}}}
"""
THRESHOLDS = {"time": 1.1, "ratio": 1.0}
STANDARD_ERRORS = 2.0


def run(recipe: Path, *options: str) -> dict[str, Any]:
    """Run a recipe from outside: seconds, preset, error and bytes of the data.

    Raises
    ------
    SystemExit : the run failed
    """
    with tempfile.TemporaryDirectory() as work:
        out = Path(work, "run")
        command = [sys.executable, "-m", "mbtf_pipeline", "run", str(recipe), *options, "-o", str(out)]
        start = time.perf_counter()
        done = subprocess.run([*command, "--json"], stdout=subprocess.PIPE, text=True, check=False)
        seconds = time.perf_counter() - start
        if done.returncode:
            raise SystemExit(f"{' '.join(command)} ended with exit code {done.returncode}")
        summary = json.loads(done.stdout)
        error = summary["test"]["relief"]["unexplained_variance"]
        manifest = read_json(out / "shards" / "manifest.json")
        return {
            "quality": summary["quality"],
            "seconds": round(seconds, 1),
            "stages": {name: stage["seconds"] for name, stage in summary["stages"].items()},
            "unexplained": error["value"],
            "unexplained_error": error["error"],
            "queries": manifest["splits"]["train"]["queries"],
            "data_bytes": sum(p.stat().st_size for p in (out / "shards").iterdir()),
        }


def pair(name: str, seed: int, duration: str, resolution: int | None, folder: Path) -> dict[str, Any]:
    """One material and seed under ``--time`` and at the preset that it chose; kept in a folder."""
    path = folder / f"{name}-{seed}-{duration}-{resolution}.json"
    if path.exists():
        return read_json(path)
    material, height = source(name)
    recipe = folder / "recipe.yaml"
    values = {"material": str(material), "height": height, "seed": seed, "resolution": resolution}
    text = RECIPE.format(**{key: json.dumps(value) for key, value in values.items()})
    recipe.write_text(text, encoding="utf-8")
    timed = run(recipe, "--time", duration)
    preset = run(recipe, "--quality", timed["quality"])
    found = {"material": name, "seed": seed, "timed": timed, "preset": preset}
    write_json(path, found)
    print(json.dumps(found), file=sys.stderr, flush=True)
    return found


def compared(name: str, pairs: list[dict[str, Any]], seconds: float) -> dict[str, Any]:
    """Error under ``--time`` over that of the preset, with its standard error; longest run over the time."""
    logs = [math.log(p["timed"]["unexplained"] / p["preset"]["unexplained"]) for p in pairs]
    relative = [p[k]["unexplained_error"] / p[k]["unexplained"] for p in pairs for k in ("timed", "preset")]
    # The larger of the test sets' error and the scatter over seeds.
    bar = math.sqrt(sum(r * r for r in relative)) / len(pairs)
    if len(pairs) > 1:
        bar = max(bar, statistics.stdev(logs) / math.sqrt(len(pairs)))
    ratio = math.exp(statistics.fmean(logs))
    longest = max(p["timed"]["seconds"] for p in pairs) / seconds
    return {"material": name, "ratio": ratio, "ratio_error": bar * ratio, "time": longest, "runs": pairs}


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("materials", nargs="*", default=list(HEIGHT_SCALES))
    parser.add_argument("--time", default="2min", help="total time of a run")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--resolution", type=int, help="texels across; default: the preset's")
    parser.add_argument("--out", type=Path, help="folder of the finished runs")
    arguments = parser.parse_args()
    seconds = parse_duration(arguments.time)
    folder = arguments.out or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    found = []
    for name in arguments.materials:
        if not source(name)[0].is_dir():
            print(f"{name}: skipped, {source(name)[0]} is missing", file=sys.stderr)
            continue
        pairs = [
            pair(name, seed, arguments.time, arguments.resolution, folder) for seed in range(arguments.seeds)
        ]
        one = compared(name, pairs, seconds)
        found.append(one)
        print(
            f"{name:16s} error over the preset's {one['ratio']:.2f} ± {one['ratio_error']:.2f}, "
            f"{one['time']:.2f} of the time"
        )
    if arguments.out is None:
        shutil.rmtree(folder)
    met = bool(found)
    for one in found:
        met &= one["time"] <= THRESHOLDS["time"]
        met &= one["ratio"] - STANDARD_ERRORS * one["ratio_error"] <= THRESHOLDS["ratio"]
    print(json.dumps({"figures": found, "thresholds": THRESHOLDS, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
