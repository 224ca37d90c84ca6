"""Opening of a data set for the training of a model, which must suit it."""

from __future__ import annotations

import shlex
from pathlib import Path

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.schema import CONFIG_NAME, Layout
from mbtf_core.errors import InputError
from mbtf_fit.models.registry import model_class

# Fewest queries per texel, whole images or slices of all texels, from which a fit is worthwhile.
_FEWEST_PER_TEXEL = 20


def open_data(folder: str | Path | DataFolder, model: str, cache: float | None = None) -> Dataset:
    """Open a folder of shards to train a model of this name; `cache` as in :meth:`Dataset.open`.

    Raises
    ------
    InputError : it cannot be read, has another layout than the model needs, or lacks the geometry
    """
    data, needs = Dataset.open(folder, cache), model_class(model)
    if not needs.reads(data.layout):
        raise InputError(
            f"the data set has the {data.layout} layout, but {model} needs the {needs.layout} layout",
            where=data.folder,
            hint=f"generate them: {_generated_again(data, needs.layout, model)}"
            if data.estimates == 2
            else "measured data have no other layout; choose another model: --model neumip+",
        )
    record = data.manifest["geometry"]
    if missing := [name for name in needs.reads_geometry if name not in (record or {}).get("channels", {})]:
        lacks = "no geometry" if record is None else f"no '{missing[0]}' in its geometry"
        raise InputError(
            f"the data set has {lacks}, which {model} reads",
            where=data.folder,
            hint=f"fit another model: --model {'neumip+' if record is None else 'relief'}",
        )
    return data


def _generated_again(data: Dataset, layout: Layout, model: str) -> str:
    """The commands that generate a data set again in a layout, and fit a model to it."""
    material = (data.manifest.get("config") or {}).get("material")
    if material is None:
        return f"mbtf-gen ... --layout {layout}"
    folder = f"{data.folder}-{layout}"
    words = ["mbtf-gen", material, "--config", data.folder.at(CONFIG_NAME), "--layout", layout]
    if data.manifest["splits"]["train"].get("queries", 0) < _FEWEST_PER_TEXEL * data.lattice.texels():
        words += ["--queries", "100/texel"]
    fit = shlex.join(["mbtf-fit", folder, "--model", model])
    return f"{shlex.join([*words, '-o', folder])} && {fit}"
