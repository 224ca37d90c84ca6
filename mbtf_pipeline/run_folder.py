"""The folder of a run.

out/NAME/run.json        which command made it
         recipe.yaml     the resolved recipe, runnable again
         shards/         the data set, as ``mbtf-gen`` makes it
         fits/FIT/       each fitted material, as ``mbtf-fit`` makes it
         compare/        pictures, offsets, errors
         report.html     the report
         stages/         a stamp per finished stage
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path

from mbtf_core.atomic import read_json, write_json
from mbtf_core.errors import InputError, PartialError
from mbtf_core.folders import check_folder, make_folder
from mbtf_pipeline.recipe import Recipe, write_recipe

RUN_NAME = "run.json"
RUN_FORMAT = "mbtf-run"
RUN_SCHEMA = 1
SHARDS, FITS, COMPARE, REPORT = "shards", "fits", "compare", "report.html"


def clear(folder: Path) -> None:
    """Remove what an earlier run left in one of our own sub-folders."""
    if folder.exists():
        shutil.rmtree(folder)


def claim(folder: Path) -> None:
    """Make a run's folder, or take an empty one or one that holds a run.

    Raises
    ------
    InputError : it holds something else
    """
    check_folder(folder, is_run, "run")
    make_folder(folder)


def describe(folder: Path, recipe: Recipe, command: str) -> None:
    """Write what is run, and the command that does it, into the run's folder."""
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
    """Versions of what results depend on, and what they ran on."""
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
    """Whether a folder holds a run of a recipe."""
    try:
        return read_json(folder / RUN_NAME).get("format") == RUN_FORMAT
    except InputError:
        return False


@contextlib.contextmanager
def locked(folder: Path, record: str = RUN_NAME) -> Iterator[None]:
    """Hold a folder against other runs; `record` is the file that stands for it.

    Raises
    ------
    PartialError : another process holds it
    """
    from mbtf_core.locks import shard_lock

    with shard_lock(folder / record) as held:
        if not held:
            raise PartialError(
                "another run is at work here",
                where=folder,
                hint="wait for it, or choose another folder with -o",
            )
        yield
