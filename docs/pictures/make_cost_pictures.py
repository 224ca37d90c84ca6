"""Makes the figures of the documentation from folders of cost studies, and prints tables of Pareto fronts.

From the repository's root, after the studies:
``.venv/bin/python docs/pictures/make_cost_pictures.py out/cost/turtle_shell out/cost/twisted_wool …``.
Every sheet shows one plot of all studies side by side; studies without that plot are left out.
"""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from mbtf_pipeline.cost.fit_runs import PRESET

HERE = Path(__file__).parent
OUT = HERE / "cost"
PLOTS = (
    "front",
    "data",
    "models",
    "models_evaluation",
    "paths",
    "effects",
    "mesh",
    "interactions",
)
WIDTH, TITLE, GAP, COLUMNS, COLORS = 800, 30, 12, 2, 256


def sheet(plot: str, studies: list[Path]) -> Path | None:
    """One plot of all studies, each under its name."""
    found = [folder for folder in studies if (folder / f"{plot}.png").exists()]
    if not found:
        return None
    pictures = []
    for folder in found:
        drawn = Image.open(folder / f"{plot}.png").convert("RGBA")
        white = Image.new("RGBA", drawn.size, (255, 255, 255, 255))
        picture = Image.alpha_composite(white, drawn).convert("RGB")
        height = round(picture.height * WIDTH / picture.width)
        pictures.append(picture.resize((WIDTH, height), Image.Resampling.LANCZOS))
    columns = min(COLUMNS, len(found))
    rows = -(-len(found) // columns)
    cell = (WIDTH + GAP, max(p.height for p in pictures) + TITLE)
    out = Image.new("RGB", (columns * cell[0] - GAP, rows * cell[1]), (255, 255, 255))
    draw = ImageDraw.Draw(out)
    for number, (folder, picture) in enumerate(zip(found, pictures, strict=True)):
        x, y = (number % columns) * cell[0], (number // columns) * cell[1]
        draw.text((x + 12, y + 4), folder.name, (30, 30, 30), ImageFont.load_default(20))
        out.paste(picture, (x, y + TITLE))
    path = OUT / f"{plot}.png"
    out.quantize(COLORS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(path, optimize=True)
    return path


def front_rows(folder: Path) -> list[dict[str, str]]:
    """Rows of the study on the Pareto front: no other one beats them in both time and error."""
    with (folder / "cost.csv").open(encoding="utf-8", newline="") as stream:
        rows = [r for r in csv.DictReader(stream) if r["total_seconds"] and r["error"]]
    front: list[dict[str, str]] = []
    for row in sorted(rows, key=lambda r: (float(r["total_seconds"]), float(r["error"]))):
        if not front or float(row["error"]) < float(front[-1]["error"]):
            front.append(row)
    return front


def table(studies: list[Path]) -> str:
    """The seed variance, and the Pareto fronts of all studies with commands, as Markdown."""
    records = {f: json.loads((f / "study.json").read_text(encoding="utf-8")) for f in studies}
    lines = ["| study | standard deviation over seeds |", "|---|---|"]
    for folder, study in records.items():
        found = study.get("summary")
        if found is None:
            raise SystemExit(f"{folder}: not finished; run the command of the study again")
        deviation = found["seed_deviation"]
        text = (
            "–" if deviation is None else f"{100 * deviation['value']:.1f} ± {100 * deviation['error']:.1f} %"
        )
        lines.append(f"| `{folder.name}` | {text} |")
    lines.append("")
    for folder, study in records.items():
        where = f"{study['machine']['system']}, {study['date']}"
        lines += [
            f"`{folder.name}`, {where}:",
            "",
            "| total | generating | training | queries × paths | model | unexplained variance |",
            "|---|---|---|---|---|---|",
        ]
        front = front_rows(folder)
        for r in front:
            lines.append(
                f"| {float(r['total_seconds']):.0f} s | {float(r['generation_seconds']):.1f} s "
                f"| {float(r['training_seconds']):.1f} s "
                f"| {float(r['queries']) / 1e6:.2g} M × {float(r['spp']):g} "
                f"| {r['series'] if r['study'] == 'models' else PRESET} "
                f"| {float(r['error']):.3f} ± {float(r['error_se']):.3f} |"
            )
        command = front[-1]["command"].replace(str(folder), f"out/cost/{folder.name}")
        lines += ["", "The last one:", "", f"    {command.replace(' && ', chr(10) + '    ')}", ""]
    return "\n".join(lines)


def main() -> int:
    """Write the sheets and print the tables."""
    studies = [Path(name) for name in sys.argv[1:]]
    if not studies:
        print(__doc__, file=sys.stderr)
        return 2
    OUT.mkdir(exist_ok=True)
    for plot in PLOTS:
        path = sheet(plot, studies)
        if path is not None:
            print(f"{path}: {path.stat().st_size / 1e3:.0f} kB", file=sys.stderr)
    print(table(studies))
    return 0


if __name__ == "__main__":
    sys.exit(main())
