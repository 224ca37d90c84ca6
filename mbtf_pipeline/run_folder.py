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

from mbtf_core.config.settings import check_schema
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import read_json, write_json
from mbtf_pipeline.recipe import Recipe, write_recipe

RUN_NAME = "run.json"
RUN_FORMAT = "mbtf-run"
RUN_SCHEMA = 2
SHARDS, FITS, COMPARE, REPORT = "shards", "fits", "compare", "report.html"
VIEWER = "viewer.html"


def clear(folder: Path) -> None:
    """Remove a sub-folder of a run with everything in it."""
    if folder.exists():
        shutil.rmtree(folder)


def write_run_record(folder: Path, recipe: Recipe, command: str) -> None:
    """Write the resolved recipe and the command into the run's folder."""
    write_json(
        folder / RUN_NAME,
        {
            "format": RUN_FORMAT,
            "schema": RUN_SCHEMA,
            "name": recipe.name,
            "command": command,
            "machine": machine(),
        },
    )
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


def is_run(folder: Path) -> bool:
    """Whether a folder contains a run of a recipe.

    Raises
    ------
    InputError : it contains a run of another schema version
    """
    return has_record(folder, RUN_NAME, RUN_FORMAT, RUN_SCHEMA)


def has_record(folder: Path, name: str, record_format: str, schema: int) -> bool:
    """Whether a folder contains a record of this format.

    Raises
    ------
    InputError : the record has another schema version
    """
    try:
        record = read_json(folder / name)
    except InputError:
        return False
    if record.get("format") != record_format:
        return False
    check_schema(record, schema, folder / name, "run the recipe again in another folder with -o")
    return True
