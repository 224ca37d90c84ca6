"""``mbtf-fit info`` and ``mbtf-fit models``: descriptions of materials, data sets and models."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import Switch, Verbose
from mbtf_core.errors import InputError
from mbtf_core.paths import suggest_path
from mbtf_core.units import clock
from mbtf_fit.cli.results import report_errors

if TYPE_CHECKING:
    from mbtf_core.data.folder import DataFolder


def info(path: Path, /, *, verbose: Verbose = False, console: Console = CONSOLE) -> None:
    """Describe a material or a data set.

    Parameters
    ----------
    path
        Folder made by mbtf-fit or by mbtf-gen, or the URL of a data set.
    """
    from mbtf_core.data.folder import DataFolder

    folder = DataFolder.open(path)
    if not folder.exists():
        raise InputError("no such folder", where=path, hint=suggest_path(path, Path.is_dir))
    from mbtf_core.data.dataset import is_dataset

    data, text = _shards_info(folder) if is_dataset(folder) else _material_info(path, verbose)
    console.report(data, text)


def _shards_info(folder: DataFolder) -> tuple[dict[str, Any], str]:
    from mbtf_core.data.dataset import Dataset

    data = Dataset.open(folder)
    lattice = data.lattice
    rows, columns = lattice.shape()
    splits = {
        s: {
            "shards": len(data.shards(s)),
            "rows": sum(x.rows for x in data.shards(s)),
            "lights_per_path": data.lights_per_path(s),
        }
        for s in data.splits
    }
    kind = {"shuffled": "queries", "image": "images", "slices": "positions"}[data.layout]
    # Data sets of other programs may lack these.
    manifest = data.manifest
    config, measured = manifest.get("config") or {}, manifest.get("measured")
    material = measured["file"] if measured else config.get("material")
    width = data.light_width
    least = (config.get("queries") or config).get("min_cos")
    noise = (manifest.get("summary") or {}).get("relative_error")
    light = (
        "light of unknown width" if width is None else f"light {width:g}° wide" if width else "delta light"
    )
    if least is not None:
        light += f", elevations from {math.degrees(math.asin(least)):.0f}° (cosine {least:g})"
    lines = [
        f"{folder}: shards{' of ' + material if material else ''}, {data.layout} layout",
        f"levels 0 to {lattice.finest}, finest {columns} x {rows} texels, aspect {lattice.aspect:g}; {light}",
        *(
            f"{s}: {n['rows']} {kind} in {n['shards']} {'shard' if n['shards'] == 1 else 'shards'}"
            + (f", {n['lights_per_path']} lights per path" if n["lights_per_path"] > 1 else "")
            for s, n in splits.items()
        ),
        "noise unknown" if noise is None else f"noise of a training query {noise:.1%} of the mean value",
    ]
    return {
        "shards": str(folder),
        "material": material,
        "light_width": width,
        "min_cos": least,
        "relative_noise": noise,
        "layout": data.layout,
        "levels": {"finest": lattice.finest, "shape": [rows, columns]},
        "aspect": lattice.aspect,
        "splits": splits,
    }, "\n".join(lines)


def _material_info(path: Path, verbose: bool) -> tuple[dict[str, Any], str]:
    from mbtf_fit.material.format import WEIGHTS_NAME
    from mbtf_fit.material.material import Material
    from mbtf_fit.native import describe
    from mbtf_fit.training.endings import kept_step

    material = Material.load(path)
    description = material.description
    weights, training = description["weights"], description["training"]
    size = (path / WEIGHTS_NAME).stat().st_size
    deviation = material.deviation()
    rows, columns = material.lattice.shape()
    kept = kept_step(training)
    state = "" if kept is None else f", state of step {kept} kept"
    lines = [
        f"{path}: {description['model']}, levels 0 to {material.lattice.finest}, finest {columns} x {rows} "
        f"texels, aspect {material.lattice.aspect:g}; {weights['network_weights']} network weights, "
        f"{weights['texels']} texture values, {size / 1e6:.2f} MB",
        f"trained for {training['steps']} steps of {training['batch']} queries in "
        f"{clock(training['seconds'])}{state}; evaluation on this CPU: {describe()}; conformance: "
        f"{description['conformance']['count']} queries, largest deviation {deviation:.2g}",
        *report_errors(training["errors"], training.get("transmittance"), verbose),
    ]
    return {
        "material": path,
        "bytes": size,
        "conformance_deviation": deviation,
        **{k: description[k] for k in ("model", "levels", "tile", "weights", "config", "data", "training")},
    }, "\n".join(lines)


def models(*, operations: Switch = False, console: Console = CONSOLE) -> None:
    """List the models that --model takes, with the layout of their data.

    Parameters
    ----------
    operations
        List instead the operations that a model is made of.
    """
    from mbtf_core.app.console import format_table
    from mbtf_fit.models.registry import MODELS, UNUSABLE
    from mbtf_fit.ops import Operation

    if operations:
        found = [
            {"name": k.__name__, "call": k.signature(), "description": k.summary().replace("`", "")}
            for k in Operation.kinds()
        ]
        lines = "\n".join(f"{one['call']}\n    {one['description']}" for one in found)
        console.report({"operations": found}, lines)
        return
    found = [
        {"name": name, "layout": model.layout, "description": model.description}
        for name, model in sorted(MODELS.items())
    ]
    rows = [["model", *list(found[0])[1:]], *(list(one.values()) for one in found)]
    faults = [f"{fault.where} {fault.what}" for fault in UNUSABLE.values()]
    console.report({"models": found, "unusable": faults}, "\n".join([format_table(rows), *faults]))
