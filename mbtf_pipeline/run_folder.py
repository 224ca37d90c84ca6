"""The folder of a run.

out/NAME/run.json        command and software versions
         recipe.yaml     resolved recipe; can be run again
         shards/         data set, as written by ``mbtf-gen``
         fits/FIT/       fitted materials, as written by ``mbtf-fit``
         compare/        images, offsets and errors
         report.html     report
         viewer.html     the fits in a browser
         stages/         one stamp per finished stage
"""

from __future__ import annotations

import shutil
from pathlib import Path

from mbtf_core.files.folders import OutputKind
from mbtf_pipeline.recipe import Recipe, write_recipe

RUN = OutputKind("run.json", "mbtf-run", 2, "a run")
SHARDS, FITS, COMPARE, REPORT = "shards", "fits", "compare", "report.html"
VIEWER = "viewer.html"


def clear(folder: Path) -> None:
    """Remove a sub-folder of a run with everything in it."""
    if folder.exists():
        shutil.rmtree(folder)


def write_run_record(folder: Path, recipe: Recipe, command: str) -> None:
    """Write the resolved recipe and the command into the run's folder."""
    RUN.write(folder, {"name": recipe.name, "command": command, "machine": machine()})
    write_recipe(recipe, folder)


def machine() -> dict[str, str]:
    """Versions of the software that results depend on, and the system."""
    import os
    import platform
    from importlib.metadata import PackageNotFoundError, version

    out = {"python": platform.python_version()}
    for name in ("mbtf", "mitsuba", "drjit", "torch", "numpy", "scipy", "trimesh", "flip-evaluator"):
        try:
            out[name] = version(name)
        except PackageNotFoundError:
            out[name] = "not installed"
    out["system"] = f"{platform.system()} {platform.machine()}, {os.cpu_count()} processors"
    return out
