"""The folder of a fit: the claim of one configuration and data set on it, and the history of validations."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mbtf_core.data.dataset import Dataset
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import data_sha256, write_text
from mbtf_core.files.folders import OutputFolder, OutputKind
from mbtf_core.paths import refuse_special, suggest_path
from mbtf_fit.config import FitConfig
from mbtf_fit.material.format import DESCRIPTION_NAME, WEIGHTS_NAME, read_description
from mbtf_fit.material.transmittance import TRANSMITTANCE_NAME
from mbtf_fit.models import code_of
from mbtf_fit.models.registry import operations_of
from mbtf_fit.training.loop import CHECKPOINT_NAME

HISTORY_NAME = "metrics.jsonl"
FIT = OutputKind("fit.json", "mbtf-fit", 3, "a fit")
# The description goes first: without it nothing counts as a finished material.
_FILES = (
    *(DESCRIPTION_NAME, HISTORY_NAME, CHECKPOINT_NAME),
    *(WEIGHTS_NAME, TRANSMITTANCE_NAME, "layers.json", "textures.exr"),
)


def identity_of(config: FitConfig, data: Dataset, group: Sequence[Dataset] = ()) -> dict[str, Any]:
    """Configuration and data of a fit, and the hash of both; `group`: data sets of the materials that share
    the network, in their order."""
    files = {split: [e["file"] for e in data.manifest["splits"][split]["shards"]] for split in data.splits}
    described = {
        "hash": str(data.manifest.get("config_hash", "")),
        "levels": data.lattice.finest,
        "aspect": data.lattice.aspect,
    }
    lengths = {split: len(names) for split, names in files.items()}
    # Other data sets count by what they hold, not by where they lie.
    others = tuple(Dataset.open(folder).manifest["config_hash"] for folder in config.training.materials)
    training = config.training.model_copy(update={"materials": others})
    without_paths = config.model_copy(update={"training": training})
    config_hash = without_paths.hash(data_sha256({**described, "files": files}))
    # A model whose operations or file have changed is another one.
    operations = operations_of(config.model, data.lattice, config.network)
    model = data_sha256([operation.as_json() for operation in operations])
    config_hash += "".join(f"-{digest}" for digest in (model, *code_of(config.model).values()))
    if config.decoder is not None:
        description, _ = read_description(Path(config.decoder))
        config_hash += f"-{description['weights']['sha256']}"
    if group:
        config_hash += f"-{data_sha256([other.manifest['config_hash'] for other in group])}"
    queries = (data.manifest.get("config") or {}).get("queries") or {}
    directions = {"min_cos": queries["min_cos"]} if "min_cos" in queries else {}
    return {
        "config_hash": config_hash,
        "config": config.fields(),
        "operations": model,
        "data": {**described, **directions, "shards": lengths, "inputs": data.manifest.get("inputs", {})},
    }


def training_digest(data: Dataset) -> str:
    """SHA-256 over those of the shards of training queries."""
    return data_sha256([shard.sidecar["sha256"] for shard in data.shards("train")])


def claim(out: Path, identity: dict[str, Any], config: FitConfig, overwrite: bool) -> OutputFolder:
    """Claim the folder for a fit, or check that it already belongs to it."""
    return OutputFolder.claim(
        out,
        FIT,
        {**identity["config"], "operations": identity["operations"], "data": identity["data"]},
        _FILES,
        config=config.model_dump(mode="json"),
        digest=identity["config_hash"],
        overwrite=overwrite,
    )


def append_history(folder: Path, record: dict[str, Any]) -> None:
    """Add a record to the history of a fit."""
    refuse_special(folder / HISTORY_NAME)
    with (folder / HISTORY_NAME).open("a", encoding="utf-8") as stream:
        stream.write(json.dumps(record) + "\n")


def truncate_history(folder: Path, step: int) -> None:
    """Remove the records after a step, to which a fit returns; all of them at step 0."""
    if step == 0:
        (folder / HISTORY_NAME).unlink(missing_ok=True)
        return
    kept = [line for line in read_history(folder) if line.get("step", 0) <= step]
    write_text(folder / HISTORY_NAME, "".join(json.dumps(line) + "\n" for line in kept))


def read_history(folder: str | Path) -> list[dict[str, Any]]:
    """Read the validation history of a fit; records after a corrupt line are left out.

    Parameters
    ----------
    folder : str or Path
        Folder of the material.

    Returns
    -------
    list of dict
        One record per validation, in order of time:

        step : int
            Steps done.
        seconds : float
            Training time in seconds.
        fraction : float
            Fraction of the budget that is spent, in [0, 1].
        loss : float
            Mean training loss since the record before.
        unexplained, unexplained_error : float or None
            Unexplained variance of the validation subset (1 - R²), and its standard error.
        queries_per_second : int
            Training throughput.

    Raises
    ------
    InputError
        There is no such folder.
    """
    path = Path(folder) / HISTORY_NAME
    if not path.parent.is_dir():
        raise InputError("no such folder", where=folder, hint=suggest_path(path.parent, Path.is_dir))
    refuse_special(path)
    out = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else []:
        try:
            record = json.loads(line)
        except (ValueError, RecursionError):
            break
        if not isinstance(record, dict):
            break
        out.append(record)
    return out
