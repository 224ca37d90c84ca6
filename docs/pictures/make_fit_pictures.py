"""Make the pictures of fits in README and docs/start: ball.jpg, first_comparison.jpg and sheet.jpg.

From the repository's root, after ``make demo``, in five minutes: ``.venv/bin/python
docs/pictures/make_fit_pictures.py``. Each command is printed. Results are kept in out/fit_pictures.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

from PIL import Image

import mbtf_fit.backends.mitsuba

ROOT = Path(__file__).parents[2]
WORK = Path("out/fit_pictures")
TURTLE_SHELL = "out/quickstart/fits/relief"
SIZE, SPP = 480, 64


def run(program: str, arguments: str, output: str) -> Path:
    """Run one of our programs and return its output folder; a finished one is not made again.

    Raises
    ------
    subprocess.CalledProcessError
        If the program fails.
    """
    print(f"mbtf-{program} {arguments} -o {WORK / output}", flush=True)
    words = [*shlex.split(arguments), "-o", str(WORK / output), "--quiet"]
    subprocess.run([sys.executable, "-m", f"mbtf_{program}", *words], check=True, cwd=ROOT)
    return ROOT / WORK / output


def save(picture: Image.Image, name: str) -> None:
    """Write a picture beside this file."""
    picture.convert("RGB").save(Path(__file__).with_name(f"{name}.jpg"), quality=82)


def ball() -> None:
    """The scene of examples/ with the quickstart's turtle shell."""
    mbtf_fit.backends.mitsuba.register("llvm_ad_rgb")
    import mitsuba as mi

    source, material = ROOT / "examples/ball.xml", ROOT / TURTLE_SHELL
    scene = mbtf_fit.backends.mitsuba.load_scene(
        str(source), material=str(material), silhouettes=True, size=SIZE, spp=SPP
    )
    path = ROOT / WORK / "ball.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    mi.util.write_bitmap(str(path), mi.render(scene), write_async=False)
    save(Image.open(path), "ball")


def first_comparison() -> None:
    """The fit of docs/start/first-material.md beside its reference."""
    data = run("gen", "assets/twisted_wool --resolution 64 --queries 200/texel", "small")
    fit = run("fit", f"{data.relative_to(ROOT)} --time 30s", "material")
    folders = f"{fit.relative_to(ROOT)} {data.relative_to(ROOT)}"
    compared = run("fit", f"compare {folders} --tiles-across 2", "comparison")
    save(Image.open(compared / "comparison.png"), "first_comparison")


def main() -> None:
    """Write the pictures."""
    ball()
    first_comparison()
    sheet = run("fit", f"preview {TURTLE_SHELL}", "sheet")
    save(Image.open(sheet / "sheet.png"), "sheet")


if __name__ == "__main__":
    main()
