"""What the qualities cost and reach: the whole chain of each material at a quality.

    python benchmarks/quality.py [MATERIAL ...] [--quality draft] [--levels 7] [--store FILE]

Runs ``mbtf-pipeline run`` in a process of its own on each material (by default the five of ``assets/``) at
each quality asked for (repeatable), and prints its seconds, start-up included, the unexplained variance of
test queries, and the bytes of data and material. ``--store`` writes the figures with date and machine.

The last line is one JSON object: figures, and the bars they are held to (a draft takes at most a minute, a
standard run ten, on two cores, at 128 x 128 texels). Exit code 1 where a bar is missed.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, get_args

from mbtf_gen.quality import Quality
from mbtf_pipeline.run_folder import machine

ROOT = Path(__file__).resolve().parents[1]
ASSETS = ("cliff_rock", "insulation_foam", "straight_wool", "turtle_shell", "twisted_wool")
# Seconds of the whole chain.
BARS = {"draft": 60.0, "standard": 600.0}
BAR_LEVELS = 7
RECIPE = """\
name: quality
generate:
  material: {material}
  queries: {{levels: {levels}}}
fit: {{model: neumip}}
"""


def folder_bytes(folder: Path) -> int:
    """Bytes of all files below a folder."""
    return sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())


def run(material: Path, quality: str, levels: int, work: Path) -> dict[str, Any]:
    """One chain, timed from outside.

    Raises
    ------
    SystemExit : the chain failed; its message is shown
    """
    recipe = work / "recipe.yaml"
    recipe.write_text(RECIPE.format(material=json.dumps(str(material.resolve())), levels=levels))
    out = work / f"{material.name}-{quality}"
    command = [sys.executable, "-m", "mbtf_pipeline", "run", str(recipe), "--quality", quality]
    start = time.perf_counter()
    done = subprocess.run(
        [*command, "-o", str(out), "--json", "--quiet"], stdout=subprocess.PIPE, text=True, check=False
    )
    seconds = time.perf_counter() - start
    if done.returncode:
        raise SystemExit(f"{material} at {quality} ended with exit code {done.returncode}")
    summary = json.loads(done.stdout)
    return {
        "material": material.name,
        "quality": quality,
        "levels": levels,
        "seconds": round(seconds, 1),
        "stages": {name: round(stage["seconds"], 1) for name, stage in summary["stages"].items()},
        "unexplained": summary["test"]["neumip"]["unexplained_variance"],
        "data_bytes": folder_bytes(out / "shards"),
        "material_bytes": sum(p.stat().st_size for p in (out / "fits" / "neumip").glob("weights*")),
    }


def line(row: dict[str, Any]) -> str:
    """A row as text."""
    missed = row["unexplained"]
    stages = "  ".join(f"{name} {seconds:g}" for name, seconds in row["stages"].items())
    return (
        f"{row['material']:18s} {row['quality']:9s} {row['seconds']:7.1f} s  unexplained "
        f"{missed['value']:.3f} ± {missed['error']:.3f}  data {row['data_bytes'] / 1e6:.0f} MB  material "
        f"{row['material_bytes'] / 1e6:.2f} MB  ({stages})"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("materials", nargs="*", type=Path)
    parser.add_argument("--quality", action="append", choices=get_args(Quality))
    parser.add_argument("--levels", type=int, default=BAR_LEVELS, help="finest level: 2^levels texels")
    parser.add_argument("--store", type=Path, help="JSON file for the figures")
    arguments = parser.parse_args()
    materials = arguments.materials or [ROOT / "assets" / name for name in ASSETS]
    rows = []
    for material in materials:
        for quality in arguments.quality or ["draft"]:
            with tempfile.TemporaryDirectory() as work:
                rows.append(run(material, quality, arguments.levels, Path(work)))
            print(line(rows[-1]), flush=True)
    held = [r for r in rows if r["quality"] in BARS and r["levels"] <= BAR_LEVELS]
    met = all(r["seconds"] <= BARS[r["quality"]] for r in held)
    report = {
        "figures": rows,
        "bars": BARS,
        "met": met,
        "date": time.strftime("%Y-%m-%d"),
        "machine": machine(),
    }
    if arguments.store is not None:
        arguments.store.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(report))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
