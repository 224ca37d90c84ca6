"""Opening of a data set for the training of a model, which must suit it."""

from __future__ import annotations

from pathlib import Path

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.folder import DataFolder
from mbtf_core.errors import InputError
from mbtf_fit.material.transmittance import has_transmittance
from mbtf_fit.models.registry import model_class


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
            hint=f"generate them: mbtf-gen ... --layout {needs.layout}"
            if data.estimates == 2
            else "measured data have no other layout; choose another model: --model neumip+",
        )
    record = data.manifest["geometry"]
    if not set(needs.reads_geometry) <= {*(record or {}).get("channels", ())}:
        lacks, other = ("geometry", "neumip+") if record is None else ("fibers in its geometry", "relief")
        raise InputError(
            f"the data set has no {lacks}, which {model} reads",
            where=data.folder,
            hint=f"fit another model: --model {other}",
        )
    if has_transmittance(data):
        # Its layers need the depth: better refused here than after the training.
        data.geometry()
    return data
