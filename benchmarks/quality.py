"""What the qualities cost and reach: the whole chain of each material at a quality.

    python benchmarks/quality.py --out FOLDER [--only MATERIAL:QUALITY ...] [--resolution 128]
                                 [--store] [--check]

Runs ``mbtf-pipeline run`` in a process of its own for every material and quality of the table in
docs/cost.md: ``draft`` and ``standard`` on the six texture sets that lie beside the project, ``high`` on one.
The last one is measured with a quarter of its training, too: from both ``paper`` is extrapolated. ``--only``
(repeatable) names single ones, also of ``assets/``, such as ``turtle_shell:draft``. Printed: its seconds,
start-up, pictures and report included, the unexplained variance of test queries, and the bytes of data and
material. Each is kept in FOLDER as soon as it is measured and not measured again, unless the
quality has got other settings since, so the same command goes on where it stopped.

``--store`` writes what FOLDER holds to ``mbtf_gen/quality_measured.json``, from which help texts and
``mbtf-gen plan`` speak, and the table of docs/cost.md. ``--check`` holds what FOLDER holds against the stored
figures instead.

The last line is one JSON object: figures, and the bars they are held to (a draft takes at most a minute, a
standard run ten, on two cores, at 128 x 128 texels; under ``--check`` seconds within 30 % and errors within a
factor 1.5 of the stored ones, of which there is one at least). Exit code 1 where a bar is missed.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import subprocess
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any, get_args

from mbtf_core.atomic import read_json, write_json
from mbtf_core.config_file import resolve
from mbtf_core.errors import InputError
from mbtf_core.units import parse_duration
from mbtf_fit.config import FitConfig
from mbtf_fit.presets import FITTER
from mbtf_fit.training.forecast import PERSISTENCE, extrapolated
from mbtf_gen.config.generator import GeneratorConfig, count_queries
from mbtf_gen.config.presets import GENERATOR, Quality, as_assignments
from mbtf_gen.config.quality_measured import FORMAT, STORED, PresetRun, markdown_table, read_expected
from mbtf_pipeline.fit_records import read_training
from mbtf_pipeline.presets import settings_hash
from mbtf_pipeline.run_folder import machine

ROOT = Path(__file__).resolve().parents[1]
TEXTURE_SETS = ROOT.parent / "shared" / "data" / "materials"
# Factor on the heights of each set: fine structure is exaggerated so that it shows.
HEIGHTS: dict[str, float] = {
    "knit_fabric": 0.05,
    "leather_fine": 0.02,
    "metal_plate": 0.05,
    "rock_cliff": 0.12,
    "stone_bricks": 0.06,
    "tree_bark": 0.1,
}
# The set that `high` is measured on, and `paper` extrapolated for, and the share of its training that another
# fit of it gets.
LONG = "rock_cliff"
QUARTER = 0.25
# Seconds of the whole chain.
BARS = {"draft": 60.0, "standard": 600.0}
BAR_RESOLUTION = 128
# Largest factors between a stored figure and another run.
CHECK = {"seconds": 1.3, "error": 1.5}
QUALITIES: tuple[Quality, ...] = get_args(Quality)
PAGE = ROOT / "docs" / "cost.md"
BEGIN, END = "<!-- qualities: begin -->", "<!-- qualities: end -->"
RECIPE = """\
name: quality
generate:
  material: {material}
  geometry: {{height_scale: {height}}}
  queries: {{resolution: {resolution}}}
fit: {{model: neumip}}
"""


def source(name: str) -> tuple[Path, float | None]:
    """Folder of a material and the factor on its heights."""
    if name in HEIGHTS:
        return TEXTURE_SETS / name, HEIGHTS[name]
    return ROOT / "assets" / name, None


def generator_config(name: str, quality: Quality, resolution: int) -> GeneratorConfig:
    """The generator's configuration of a material at a quality."""
    material, height = source(name)
    return resolve(
        GeneratorConfig,
        assignments=[
            f"material={json.dumps(str(material))}",
            *as_assignments(GENERATOR[quality]),
            *as_assignments({"geometry.height_scale": height, "queries.resolution": resolution}),
        ],
    )


def folder_bytes(folder: Path) -> int:
    """Bytes of all files below a folder."""
    return sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())


def run(name: str, quality: Quality, resolution: int, work: Path, share: float = 1.0) -> PresetRun:
    """One chain that trains for a share of the quality's time, timed from outside; what an interrupted one
    left in `work` was not, and is removed.

    Raises
    ------
    SystemExit : the chain failed; its message is shown
    """
    material, height = source(name)
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    recipe, out = work / "recipe.yaml", work / "run"
    text = RECIPE.format(
        material=json.dumps(str(material)),
        resolution=resolution,
        height="null" if height is None else height,
    )
    recipe.write_text(text, encoding="utf-8")
    command = [sys.executable, "-m", "mbtf_pipeline", "run", str(recipe), "--quality", quality]
    if share != 1:
        training = share * parse_duration(FITTER[quality]["training.time"])
        command += ["--set", f"fit.training.time={training:g}s"]
    start = time.perf_counter()
    done = subprocess.run(
        [*command, "-o", str(out), "--json", "--quiet"], stdout=subprocess.PIPE, text=True, check=False
    )
    seconds = time.perf_counter() - start
    if done.returncode:
        raise SystemExit(f"{name} at {quality} ended with exit code {done.returncode}")
    summary = json.loads(done.stdout)
    stages = {stage: record["seconds"] for stage, record in summary["stages"].items()}
    print(f"{name}: {json.dumps({k: round(v, 1) for k, v in stages.items()})}", file=sys.stderr)
    missed = summary["test"]["neumip"]["unexplained_variance"]
    if missed["value"] is None:
        raise SystemExit(f"{name} at {quality}: its test values do not tell an unexplained variance")
    fit = out / "fits" / "neumip"
    found = PresetRun(
        name,
        quality,
        height,
        round(seconds, 1),
        round(stages["generate"], 1),
        round(sum(s for stage, s in stages.items() if stage.startswith("fit")), 1),
        round(missed["value"], 4),
        round(missed["error"], 4),
        folder_bytes(out / "shards"),
        sum(p.stat().st_size for p in fit.glob("weights*")),
        round(read_training(fit).samples_per_second),
        settings_hash(quality),
        share,
    )
    shutil.rmtree(work)
    return found


def line(c: PresetRun) -> str:
    """A chain as text."""
    return (
        f"{c.material:16s} {c.quality:9s} {c.seconds:7.1f} s (generate {c.generate:.1f}, fit {c.fit:.1f})  "
        f"unexplained {c.unexplained:.3f} ± {c.unexplained_error:.3f}  data {c.data_bytes / 1e6:.0f} MB  "
        f"material {c.material_bytes / 1e6:.2f} MB"
    )


def wanted(only: list[str] | None) -> list[tuple[str, Quality, float]]:
    """(material, quality, share of its training) to measure.

    Raises
    ------
    SystemExit : a name that is none
    """
    if not only:
        short: tuple[Quality, ...] = ("draft", "standard")
        return [
            *((name, q, 1.0) for q in short for name in HEIGHTS),
            (LONG, "high", QUARTER),
            (LONG, "high", 1.0),
        ]
    out = []
    for text in only:
        name, _, quality = text.partition(":")
        if quality not in QUALITIES or not source(name)[0].is_dir():
            raise SystemExit(f"--only {text}: must be MATERIAL:QUALITY, such as rock_cliff:draft")
        if (name, quality) == (LONG, "high"):
            out.append((name, quality, QUARTER))
        out.append((name, quality, 1.0))
    return out


def measured(path: Path) -> PresetRun | None:
    """A chain that was measured, with the settings that its quality still has; None of another one, and of a
    file that is missing or damaged."""
    try:
        chain = PresetRun(**read_json(path))
        now = settings_hash(chain.quality)  # type: ignore[arg-type]
    except (InputError, TypeError, KeyError):
        return None
    return chain if chain.settings == now else None


def kept(folder: Path, resolution: int) -> list[PresetRun]:
    """Runs that were measured at this resolution, in the order of the table."""
    found = []
    for path in folder.glob(f"*-{resolution}.json"):
        chain = measured(path)
        if chain is None:
            print(f"{path}: left out, damaged or measured with other settings", file=sys.stderr)
        else:
            found.append(chain)
    return sorted(found, key=lambda c: (QUALITIES.index(c.quality), c.material, c.share))


def paths_of(quality: str, resolution: int) -> float:
    """Paths of a quality's data set of a square material, and those of its test split."""
    config = resolve(
        GeneratorConfig,
        assignments=["material=m", *as_assignments(GENERATOR[quality])],  # type: ignore[index]
    ).queries
    texels = resolution**2
    return (
        count_queries(config.train, texels) * config.spp
        + count_queries(config.test, texels) * config.test_spp
    )


def paper(chains: list[PresetRun], resolution: int) -> tuple[PresetRun | None, str]:
    """`paper` for the material that `high` was measured on, and how its figures follow."""
    law = (
        "Of `paper`, generating takes the seconds of `high` times the ratio of their numbers of paths, data "
        "the bytes times that of their queries, and training 30 000 steps of 2²⁰ queries at the rate of "
        "`high`. In the error's logarithm every doubling of the training time gains "
        f"q = {PERSISTENCE:g} of what the one before gained: "
        "E_paper = E_quarter · (E_high / E_quarter)^((1 − q^(p+2)) / (1 − q²)), where training takes 2^p "
        "times as long as in `high`, and E_quarter is what `high` leaves with a quarter of its training"
    )
    known = {c.share: c for c in chains if (c.material, c.quality) == (LONG, "high")}
    if known.keys() != {1.0, QUARTER}:
        return None, law
    high, quarter = known[1.0], known[QUARTER]
    law += (
        f": {quarter.unexplained:.3f} ± {quarter.unexplained_error:.3f}. That `paper` has fewer, cleaner "
        "queries is left out of account, and its bar is that of both errors alone: how far the law itself "
        "may be off, forecasts tell"
    )
    config = resolve(FitConfig, assignments=as_assignments(FITTER["paper"]))
    assert config.training.steps is not None
    samples = config.training.steps * config.training.batch
    fit = samples / high.queries_per_second
    generate = high.generate * paths_of("paper", resolution) / paths_of("high", resolution)
    doublings = math.log2(fit / high.fit)
    apart = -math.log2(QUARTER)
    error = extrapolated(quarter.unexplained, high.unexplained, doublings, apart=apart)
    # The power of `high` in the law; that of its quarter is what is left of 1.
    power = (1 - PERSISTENCE ** (doublings + apart)) / (1 - PERSISTENCE**apart)
    bars = [c.unexplained_error / c.unexplained for c in (high, quarter)]
    bar = error * math.hypot(power * bars[0], (1 - power) * bars[1])
    queries = {
        q: count_queries(GENERATOR[q]["queries.train"], resolution**2) + int(GENERATOR[q]["queries.test"])
        for q in ("high", "paper")
    }
    return (
        PresetRun(
            high.material,
            "paper",
            high.height_scale,
            round(high.seconds - high.generate - high.fit + generate + fit),
            round(generate),
            round(fit),
            round(error, 3),
            round(bar, 3),
            round(high.data_bytes * queries["paper"] / queries["high"]),
            high.material_bytes,
            high.queries_per_second,
            settings_hash("paper"),
        ),
        law,
    )


def store(chains: list[PresetRun], resolution: int) -> None:
    """Write the figures beside the package's code, and their table into the documentation."""
    guess, law = paper(chains, resolution)
    data = {
        "format": FORMAT,
        "command": "python benchmarks/quality.py --out out/quality --store",
        "date": time.strftime("%Y-%m-%d"),
        "machine": machine()["system"],
        "resolution": resolution,
        "runs": [asdict(c) for c in chains],
        "extrapolated": [] if guess is None else [asdict(guess)],
        "law": law,
    }
    STORED.write_text(json.dumps(data, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    text = PAGE.read_text(encoding="utf-8")
    before, rest = text.split(BEGIN)
    table = markdown_table(read_expected(STORED), QUALITIES)
    PAGE.write_text(f"{before}{BEGIN}\n\n{table}\n\n{END}{rest.split(END)[1]}", encoding="utf-8")


def check(chains: list[PresetRun]) -> list[dict[str, Any]]:
    """Factors between the stored figures and these."""
    stored = {(c.material, c.quality, c.share): c for c in read_expected(STORED).runs}
    out = []
    for c in chains:
        other = stored.get((c.material, c.quality, c.share))
        if other is not None:
            pairs = {"seconds": (c.seconds, other.seconds), "error": (c.unexplained, other.unexplained)}
            factors = {name: max(a / b, b / a) for name, (a, b) in pairs.items()}
            out.append({"material": c.material, "quality": c.quality, "factors": factors})
    return out


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder that keeps what was measured")
    parser.add_argument("--only", action="append", help="MATERIAL:QUALITY (repeatable)")
    parser.add_argument(
        "--resolution", type=int, default=BAR_RESOLUTION, help="texels across, a power of two"
    )
    parser.add_argument(
        "--store", action="store_true", help="write the package's figures and the docs' table"
    )
    parser.add_argument("--check", action="store_true", help="hold the figures against the stored ones")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    resolution = arguments.resolution
    for name, quality, share in wanted(arguments.only):
        part = "" if share == 1 else f"-{share:g}"
        path = arguments.out / f"{name}-{quality}{part}-{resolution}.json"
        if measured(path) is not None:
            continue
        if not source(name)[0].is_dir():
            print(f"{name}: left out, {source(name)[0]} is missing", file=sys.stderr)
            continue
        found = run(name, quality, resolution, arguments.out / ".work", share)
        write_json(path, asdict(found))
        print(line(found), flush=True)
    chains = kept(arguments.out, resolution)
    held = [c for c in chains if c.quality in BARS and resolution <= BAR_RESOLUTION]
    met = all(c.seconds <= BARS[c.quality] for c in held)
    report: dict[str, Any] = {"figures": [asdict(c) for c in chains], "bars": {**BARS}}
    if arguments.check:
        report |= {"beside_stored": check(chains), "bars": {**BARS, **CHECK}}
        met &= bool(report["beside_stored"])
        met &= all(f <= CHECK[name] for row in report["beside_stored"] for name, f in row["factors"].items())
    if arguments.store:
        store(chains, resolution)
    print(json.dumps({**report, "met": met, "machine": machine()}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
