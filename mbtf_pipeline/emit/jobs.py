"""Writes the job files of a recipe, and the record of its run that lets the jobs share the run's folder."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.data.schema import MANIFEST_NAME
from mbtf_core.errors import InputError, UsageError
from mbtf_core.files.atomic import read_json, write_json, write_text
from mbtf_core.files.folders import ELSEWHERE, check_folder, make_folder, owned
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation.folder import has_dataset
from mbtf_gen.job import Job
from mbtf_pipeline.emit.kubernetes import APPLY, Cluster, kubernetes_files
from mbtf_pipeline.emit.makefile import makefile
from mbtf_pipeline.emit.places import Places, check_names
from mbtf_pipeline.emit.slurm import SUBMIT, slurm_files
from mbtf_pipeline.emit.steps import (
    CONFIGS,
    RECIPE_CONFIG,
    Request,
    Step,
    config_of,
    fit_step,
    from_here,
    generate_step,
    steps_of,
)
from mbtf_pipeline.forecast import forecast_run
from mbtf_pipeline.recipe import Recipe
from mbtf_pipeline.run import data_sets
from mbtf_pipeline.run_folder import FITS, has_record, is_run, write_run_record

Target = Literal["slurm", "k8s", "make"]

RECORD_NAME, RECORD_FORMAT, RECORD_SCHEMA = f"{CONFIGS}/jobs.json", "mbtf-jobs", 1
_SCRIPTS = (SUBMIT, APPLY)
_ELSEWHERE = "choose another folder of the run with --run-folder"


@dataclass(frozen=True)
class EmittedJobs:
    """Result of :func:`emit_jobs`.

    Attributes
    ----------
    folder : Path
        Folder of the job files.
    run : Path
        Folder of the run.
    steps : tuple of Step
        The jobs, each after those that it needs.
    files : tuple of str
        Names of the files in the folder.
    start : dict of str to str
        Target → command that starts the jobs.
    """

    folder: Path
    run: Path
    steps: tuple[Step, ...]
    files: tuple[str, ...]
    start: dict[str, str]


def emit_jobs(
    recipe: Recipe,
    folder: Path,
    targets: Sequence[Target],
    *,
    run: Path | None = None,
    slices: int = 8,
    request: Request | None = None,
    cluster: Cluster | None = None,
    command: str = "",
    overwrite: bool = False,
) -> EmittedJobs:
    """Write job files that run a recipe on a cluster, or by make.

    The commands run in the folder that is the current one now.

    Parameters
    ----------
    recipe : Recipe
        From :func:`~mbtf_pipeline.recipe.load_recipe`.
    folder : Path
        Folder of the job files.
    targets : sequence of str
        Any of ``slurm``, ``k8s`` and ``make``.
    run : Path, optional
        Folder of the run; by default the recipe's own.
    slices : int
        Jobs that share a data set; as many as it has shards at most.
    request : Request, optional
        Resources of each job; a time limit that it leaves open follows from a forecast.
    cluster : Cluster, optional
        Where the jobs of ``k8s`` run; required for that.
    command : str
        Command for the run's record.
    overwrite : bool
        Replace other job files in the folder.

    Returns
    -------
    EmittedJobs

    Raises
    ------
    ValueError
        ``k8s`` without a cluster.
    InputError
        The material cannot be used, or a folder contains something else.
    UsageError
        A path cannot be used by the jobs.
    PartialError
        Another process uses the run's folder, or the disk is full.
    """
    run = recipe.folder if run is None else run
    request = Request() if request is None else request
    material = Path(recipe.generate.material)
    check_names(folder, run, material)
    if "k8s" in targets:
        if cluster is None:
            raise ValueError("k8s needs a cluster")
        _check_inside(recipe, folder, run)
    check_folder(folder, _is_ours, "job files")
    _check_outputs(recipe, run)
    check_folder(run, is_run, "run", _ELSEWHERE)
    expected = forecast_run(recipe) if request.seconds is None else None
    steps = steps_of(recipe, run, folder, slices, request, expected)
    places = Places.of(folder)
    files = _configs(recipe, folder)
    start: dict[str, str] = {}
    if "slurm" in targets:
        files |= slurm_files(recipe.name, places, steps)
        start["slurm"] = places.start(SUBMIT)
    if "k8s" in targets and cluster is not None:
        files |= kubernetes_files(recipe.name, places, steps, cluster)
        start["k8s"] = places.start(APPLY)
    if "make" in targets:
        files |= makefile(recipe.name, places, steps)
        start["make"] = f"{places.make} -j2"
    with owned(run, _ELSEWHERE):
        check_folder(run, is_run, "run", _ELSEWHERE)
        _write(folder, files, overwrite)
        write_run_record(run, recipe, command)
    return EmittedJobs(folder, run, tuple(steps), tuple(sorted(files)), start)


def _check_inside(recipe: Recipe, folder: Path, run: Path) -> None:
    """Refuse paths outside the current folder, which the volume of Kubernetes holds."""
    others = [
        path
        for fit in recipe.fit.values()
        for path in (fit.init_from, fit.decoder, *fit.training.materials)
        if path
    ]
    for path in (folder, run, Path(recipe.generate.material), *map(Path, others)):
        if os.path.isabs(from_here(path)):
            raise UsageError(
                "lies outside the current folder, of which the volume holds a copy",
                where=path,
                hint="start the command in a folder that contains it",
            )


def _check_outputs(recipe: Recipe, run: Path) -> None:
    """Refuse a run's folder whose data or fits the jobs would refuse.

    Raises
    ------
    InputError : so it is
    """
    for data in data_sets(recipe):
        shards = run / data.sub
        if (shards / MANIFEST_NAME).exists() and not has_dataset(shards, Job.load(data.config).config_hash):
            raise _other(shards)
    for name, config in recipe.fit.items():
        out = run / FITS / name
        if (out / "fit.json").exists() and read_json(out / "fit.json").get("config") != config.fields():
            raise _other(out)


def _other(path: Path) -> InputError:
    hint = f"{_ELSEWHERE}, or remove it"
    return InputError("is of another configuration, which the jobs would not replace", where=path, hint=hint)


def _configs(recipe: Recipe, folder: Path) -> dict[str, str]:
    """The configurations that the commands read, by file name; each finds the material from its own place."""

    def located(config: GeneratorConfig) -> dict[str, Any]:
        material = from_here(Path(config.material))
        if not os.path.isabs(material):
            material = os.path.relpath(material, folder / CONFIGS)
        return {**config.model_dump(mode="json"), "material": material}

    whole = {**recipe.model_dump(mode="json"), "generate": located(recipe.generate)}
    out = {RECIPE_CONFIG: whole}
    out |= {config_of(generate_step(data)): located(data.config) for data in data_sets(recipe)}
    out |= {config_of(fit_step(name)): fit.model_dump(mode="json") for name, fit in recipe.fit.items()}
    return {f"{CONFIGS}/{name}": dump_yaml(data) for name, data in out.items()}


def _is_ours(folder: Path) -> bool:
    return has_record(folder, RECORD_NAME, RECORD_FORMAT, RECORD_SCHEMA)


def _write(folder: Path, files: Mapping[str, str], overwrite: bool) -> None:
    """Write the files; those of an earlier command are replaced on demand only."""
    if check_folder(folder, _is_ours, "job files"):
        old = [str(name) for name in read_json(folder / RECORD_NAME).get("files", ())]
        changed = [
            name for name in old if (folder / name).exists() and _differs(folder / name, files.get(name))
        ]
        if changed and not overwrite:
            hint = f"replace them with --overwrite, or {ELSEWHERE}"
            raise InputError(f"holds other job files: {', '.join(changed[:4])}", where=folder, hint=hint)
        for name in changed:
            (folder / name).unlink()
    make_folder(folder / CONFIGS)
    record = {"format": RECORD_FORMAT, "schema": RECORD_SCHEMA, "files": sorted(files)}
    write_json(folder / RECORD_NAME, record)
    for name, text in files.items():
        write_text(folder / name, text)
        if name in _SCRIPTS:
            (folder / name).chmod(0o777 & ~_umask())


def _differs(path: Path, text: str | None) -> bool:
    return text is None or path.read_bytes() != text.encode()


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
