"""Command line of ``mbtf-fit``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from mbtf_core.console import CONSOLE, Console, clock, new_app
from mbtf_core.errors import InputError, PartialError, UsageError
from mbtf_core.suggest import suggest_path
from mbtf_fit.formatting import describe_errors, describe_fit, describe_transmittance, number, table
from mbtf_fit.mitsuba_plugin.preview.command import preview
from mbtf_gen.config.presets import Quality, as_assignments

if TYPE_CHECKING:
    from mbtf_fit.config import FitConfig

app = new_app("mbtf-fit", "Fit neural materials to multi-resolution BTF (MBTF) data.")

Set = Annotated[
    list[str], Parameter(name="--set", help="Set any option of the configuration, a.b=c. Repeatable.")
]
Output = Annotated[Path, Parameter(name=["--output", "-o"])]
QualityOption = Annotated[
    Quality,
    Parameter(help="Training time and size that belong together; other options change single ones."),
]


@app.default
def fit(
    shards: Path | None = None,
    /,
    *,
    output: Output = Path("material"),
    many: Annotated[list[Path] | None, Parameter(consume_multiple=True, negative="")] = None,
    processes: int | None = None,
    quality: QualityOption | None = None,
    model: Literal["neumip", "neumip-baseline", "hierarchical"] | None = None,
    time: str | None = None,
    steps: int | None = None,
    batch: int | None = None,
    rate: float | None = None,
    seed: int | None = None,
    device: Literal["auto", "cpu", "cuda"] | None = None,
    config: Path | None = None,
    assignments: Set | None = None,
    overwrite: Annotated[bool, Parameter(negative="")] = False,
    dry_run: Annotated[bool, Parameter(negative="")] = False,
    console: Console = CONSOLE,
) -> None:
    """Fit a material to a data set: mbtf-fit shards/ -o material/

    The same command again resumes an unfinished fit.

    Parameters
    ----------
    shards
        Folder made by mbtf-gen.
    output
        Folder of the material; with --many, of a folder per material.
    many
        Fit several data sets instead: folders made by mbtf-gen, folders of such folders, or text files with
        one folder per line. A failure stops none of the others.
    processes
        With --many, fits that run side by side. Default: one per GPU, or 1
    model
        Model to fit. Default: neumip
    time
        Training time: 90s, 2min, 1h. Default: 2min
    steps
        Train this many steps instead, however long they take.
    batch
        Queries per step.
    rate
        Largest learning rate of the networks.
    seed
        Seed of the first parameters and of the order of batches.
    device
        Where to train; auto takes CUDA where there is one. Default: auto
    config
        YAML file with the options.
    overwrite
        Replace a fit of another configuration.
    dry_run
        Forecast time, error and size by two short fits on this machine, and write nothing.
    """
    if dry_run and many is not None:
        raise UsageError("--dry-run looks at one data set", hint="mbtf-fit shards/ --dry-run")
    if many is not None and shards is not None:
        raise UsageError("--many takes all data sets", hint=f"mbtf-fit --many {shards} ... -o materials/")
    if processes is not None and (many is None or processes < 1):
        raise UsageError("--processes is a positive number that goes with --many")
    if shards is None and many is None:
        raise UsageError("no shards given", hint="mbtf-fit shards/ -o material/")
    if time is not None and steps is not None:
        raise UsageError("--time and --steps exclude each other", hint="give one of them")
    from mbtf_core.config_file import resolve
    from mbtf_core.units import format_duration
    from mbtf_fit.config import FitConfig
    from mbtf_fit.presets import fitter_options, overrides_of

    flags = {
        "model": model,
        "training.time": time,
        "training.steps": steps,
        "training.batch": batch,
        "training.rate": rate,
        "seed": seed,
        "device": device,
    }
    # Time asked for on the command line takes the place of steps in a file.
    assigned: list[str] = []
    if quality is not None:
        said = {"model": model or "neumip", **overrides_of(config, assignments or [])}
        assigned = as_assignments(fitter_options(quality, {"": said})[""])
    assigned += [*(assignments or []), *(["training.steps=null"] if time is not None else [])]
    resolved = resolve(FitConfig, file=config, assignments=assigned, flags=flags)
    training = resolved.training
    budget = format_duration(training.time) if training.steps is None else f"{training.steps} steps"
    if many is not None:
        _fit_many(resolved, many, output, processes, overwrite, console)
        return
    assert shards is not None
    if dry_run:
        from mbtf_fit.training.forecast import forecast_fit

        expected = forecast_fit(resolved, shards)
        console.report(
            {"shards": shards, "model": resolved.model, "forecast": expected.as_dict()}, expected.describe()
        )
        return
    from mbtf_fit.material.format import DESCRIPTION_NAME
    from mbtf_fit.training.fit import fit

    finished = not overwrite and (output / DESCRIPTION_NAME).exists()
    if not finished:
        console.note(
            f"{shards} -> {output}: {resolved.model}, training for {budget} "
            "(change it with --time or --steps)"
        )
    from mbtf_fit.native import missing_reason

    if missing_reason():
        console.note(f"note: training runs in PyTorch, not in the compiled kernel ({missing_reason()})")
    with console.progress(total=100, label="fitting", unit="%") as bar:
        result = fit(
            resolved,
            shards,
            output,
            overwrite=overwrite,
            progress=lambda share, note: bar.update(round(100 * share, 1), note),
        )
    if finished:
        console.note(f"{output}: this fit is finished, nothing was trained; --overwrite trains it again")
    data = result.as_dict()
    price = [result.price.describe()] if result.price is not None else []
    console.report(data, "\n".join([describe_fit(data), *price]))


def _fit_many(
    config: FitConfig,
    many: list[Path],
    output: Path,
    processes: int | None,
    overwrite: bool,
    console: Console,
) -> None:
    from mbtf_fit.training.fit_many import Outcome, find_data, fit_many, name_materials

    shards = find_data(many)
    folders = name_materials(shards, output)
    if processes is None:
        import torch

        processes = max(1, torch.cuda.device_count()) if config.device != "cpu" else 1
    console.note(f"{len(shards)} data sets -> {output}: {config.model}, {processes} at a time")
    with console.progress(total=len(shards), label="fitting", unit="data sets") as bar:

        def finished(outcome: Outcome) -> None:
            bar.advance(1, f"{outcome.folder.name}: {'failed' if outcome.error else 'done'}")

        outcomes = fit_many(
            config, shards, folders, processes=processes, overwrite=overwrite, finished=finished
        )
    rows = [["material", "unexplained variance, test", "steps", "training"]]
    for outcome in outcomes:
        if outcome.result is None:
            rows.append([outcome.folder.name, "failed", "-", "-"])
            continue
        training, errors = outcome.result["training"], outcome.result["errors"]
        test = errors.get("test") or next(iter(errors.values()))
        rows.append(
            [
                outcome.folder.name,
                number(test["unexplained"]),
                str(training["steps"]),
                clock(training["seconds"]),
            ]
        )
    console.report({"fits": [o.as_dict() for o in outcomes]}, table(rows))
    failed = [o for o in outcomes if o.error is not None]
    for outcome in failed:
        console.note(f"{outcome.shards}: {outcome.error}")
    if failed:
        raise PartialError(
            f"{len(failed)} of {len(outcomes)} fits failed",
            where=output,
            hint="the same command again takes up what is not finished",
        )


@app.command
def evaluate(material: Path, shards: Path, /, *, console: Console = CONSOLE) -> None:
    """Errors of a material on a data set, free of the data's noise.

    On the test split, and on the queries and directions that were held out of training: overall, by level of
    detail, and by elevation.

    Parameters
    ----------
    material
        Folder made by mbtf-fit.
    shards
        Folder made by mbtf-gen.
    """
    from mbtf_fit.evaluation import evaluate, foreign_inputs
    from mbtf_fit.material.material import Material

    loaded = Material.load(material)
    foreign = foreign_inputs(loaded, shards)
    if foreign:
        console.note(
            f"warning: {shards} was made from another material than {material} was trained on "
            f"({', '.join(foreign)} differ{'s' if len(foreign) == 1 else ''}); these errors say how far the "
            "two are apart, not how good the fit is"
        )
    found = evaluate(loaded, shards)
    errors = {name: e.as_dict() for name, e in found.values.items()}
    through = (
        None if found.transmittance is None else {n: e.as_dict() for n, e in found.transmittance.items()}
    )
    lines = [f"{material}: {loaded.config.model} on {shards}", *describe_errors(errors)]
    console.report(
        {
            "material": material,
            "shards": shards,
            "foreign_inputs": foreign,
            "errors": errors,
            **({} if through is None else {"transmittance": through}),
        },
        "\n".join(lines + describe_transmittance(through)),
    )


@app.command(name="export")
def export_material(
    material: Path,
    /,
    *,
    to: Annotated[
        list[Literal["exr", "json", "material"]] | None, Parameter(name="--to", negative="")
    ] = None,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    half: Annotated[bool, Parameter(negative="")] = False,
    console: Console = CONSOLE,
) -> None:
    """Write a material in forms that other programs read: mbtf-fit export material/ --to exr

    exr: the latent textures, a part per level and a channel per feature, and those of the transmittance of a
    material with holes. json: the networks as a list of layers, with formulas, conventions and queries with
    expected values. material: another material folder.

    Parameters
    ----------
    material
        Folder made by mbtf-fit.
    to
        exr, json or material. Repeatable. Default: exr and json
    output
        Folder to write to. Default: the material's own
    half
        Round all weights and texels to 16 bits, and print the error of that.
    """
    from mbtf_core.folders import make_folder
    from mbtf_fit.material.export import LAYERS_NAME, TEXTURES_NAME, to_half, write_layers, write_textures
    from mbtf_fit.material.format import DESCRIPTION_NAME, WEIGHTS_NAME
    from mbtf_fit.material.material import Material, export
    from mbtf_fit.material.transmittance import TRANSMITTANCE_NAME

    wanted = list(dict.fromkeys(to or ["exr", "json"]))
    folder = material if output is None else output
    loaded = Material.load(material)
    if "material" in wanted and folder.is_dir() and any(folder.iterdir()):
        raise InputError(
            "holds something already", where=folder, hint="name a new folder with -o for --to material"
        )
    written, error = loaded, None
    if half:
        written, error = to_half(loaded)
    make_folder(folder)
    files = []
    if "exr" in wanted:
        write_textures(written, folder / TEXTURES_NAME, half=half)
        files.append(TEXTURES_NAME)
    if "json" in wanted:
        write_layers(written, folder / LAYERS_NAME, half=half)
        files.append(LAYERS_NAME)
    if "material" in wanted:
        description = loaded.description
        export(
            written.model,
            written.config,
            folder,
            data=description["data"],
            training=description["training"],
            half=half,
            holes=written.holes,
        )
        files += [WEIGHTS_NAME, DESCRIPTION_NAME, *([TRANSMITTANCE_NAME] if loaded.holes else [])]
    sizes = {name: (folder / name).stat().st_size for name in files}
    lines = [f"{folder / name}: {size / 1e6:.3f} MB" for name, size in sizes.items()]
    console.report(
        {"folder": folder, "files": sizes, "half": None if error is None else error.as_dict()},
        "\n".join([*lines, *([] if error is None else [str(error)])]),
    )


app.command(preview)


@app.command
def info(path: Path, /, *, console: Console = CONSOLE) -> None:
    """What a material or a data set holds.

    Parameters
    ----------
    path
        Folder made by mbtf-fit or by mbtf-gen.
    """
    if not path.is_dir():
        raise InputError("no such folder", where=path, hint=suggest_path(path, Path.is_dir))
    from mbtf_core.shard_schema import MANIFEST_NAME

    data, text = _shards_info(path) if (path / MANIFEST_NAME).exists() else _material_info(path)
    console.report(data, text)


def _shards_info(path: Path) -> tuple[dict[str, Any], str]:
    from mbtf_gen.dataset.reader import Dataset

    data = Dataset.open(path)
    lattice = data.lattice
    rows, columns = lattice.shape()
    splits = {
        s: {"shards": len(data.shards(s)), "rows": sum(x.rows for x in data.shards(s))} for s in data.splits
    }
    kind = "queries" if data.layout == "shuffled" else "buffers"
    lines = [
        f"{path}: shards, {data.layout} layout",
        f"levels 0 to {lattice.finest}, finest {columns} x {rows} texels, aspect {lattice.aspect:g}",
        *(f"{s}: {n['rows']} {kind} in {n['shards']} shards" for s, n in splits.items()),
    ]
    return {
        "shards": path,
        "layout": data.layout,
        "levels": {"finest": lattice.finest, "shape": [rows, columns]},
        "aspect": lattice.aspect,
        "splits": splits,
    }, "\n".join(lines)


def _material_info(path: Path) -> tuple[dict[str, Any], str]:
    from mbtf_fit.material.format import WEIGHTS_NAME
    from mbtf_fit.material.material import Material
    from mbtf_fit.native import describe

    material = Material.load(path)
    description = material.description
    weights, training = description["weights"], description["training"]
    size = (path / WEIGHTS_NAME).stat().st_size
    deviation = material.deviation()
    rows, columns = material.lattice.shape()
    lines = [
        f"{path}: {description['model']}",
        f"levels 0 to {material.lattice.finest}, finest {columns} x {rows} texels, "
        f"aspect {material.lattice.aspect:g}",
        f"{weights['network_weights']} network weights, {weights['texels']} numbers in textures, "
        f"{size / 1e6:.2f} MB",
        f"trained {training['steps']} steps of {training['batch']} in {clock(training['seconds'])}",
        f"this machine's CPU evaluates by: {describe()}",
        *describe_errors(training["errors"]),
        *describe_transmittance(training.get("transmittance")),
        f"conformance: {description['conformance']['count']} queries, largest deviation {deviation:.2g}",
    ]
    return {
        "material": path,
        "bytes": size,
        "conformance_deviation": deviation,
        **{k: description[k] for k in ("model", "levels", "tile", "weights", "config", "data", "training")},
    }, "\n".join(lines)
