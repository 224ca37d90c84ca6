"""The folder of a fit: its files, and the claim of one configuration and data set on it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mbtf_core.config.settings import check_schema
from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.data.dataset import Dataset
from mbtf_core.files.atomic import read_json, write_json, write_text
from mbtf_core.files.digest import data_sha256
from mbtf_core.files.folders import ELSEWHERE, check_folder, make_folder, other_configuration
from mbtf_fit.config import FitConfig
from mbtf_fit.material.decoder import DECODER_NAME, Decoder
from mbtf_fit.material.format import DESCRIPTION_NAME, WEIGHTS_NAME, read_description
from mbtf_fit.material.transmittance import TRANSMITTANCE_NAME
from mbtf_fit.training.checkpoint import CHECKPOINT_NAME
from mbtf_fit.training.validation import HISTORY_NAME

FIT_NAME = "fit.json"
CONFIG_NAME = "config.yaml"
_FORMAT = "mbtf-fit"
_SCHEMA = 2


def identity_of(config: FitConfig, data: Dataset, group: Sequence[Dataset] = ()) -> dict[str, Any]:
    """Content of ``fit.json``: configuration and data of a fit, and the hash of both; `group`: data sets of
    the materials that share the network, in their order."""
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
    located = config.model_copy(update={"training": training})
    config_hash = located.hash(data_sha256({**described, "files": files}))
    if config.init_from is not None:
        description, _ = read_description(Path(config.init_from))
        config_hash += f"-{description['weights']['sha256']}"
    if config.decoder is not None:
        config_hash += f"-{Decoder.find(config.decoder).sha256}"
    if group:
        config_hash += f"-{data_sha256([other.manifest['config_hash'] for other in group])}"
    queries = (data.manifest.get("config") or {}).get("queries") or {}
    directions = {"min_cos": queries["min_cos"]} if "min_cos" in queries else {}
    return {
        "format": _FORMAT,
        "schema": _SCHEMA,
        "config_hash": config_hash,
        "config": config.fields(),
        "data": {**described, **directions, "shards": lengths, "inputs": data.manifest.get("inputs", {})},
    }


def claim(out: Path, identity: dict[str, Any], config: FitConfig, overwrite: bool) -> None:
    """Claim the folder for a fit, or check that it already belongs to it."""
    if check_folder(out, lambda path: (path / FIT_NAME).exists(), "fit"):
        old = read_json(out / FIT_NAME)
        if old.get("config_hash") == identity["config_hash"] and not overwrite:
            return
        if not overwrite:
            check_schema(old, _SCHEMA, out / FIT_NAME, f"{ELSEWHERE}, or replace it with --overwrite")
            before, after = ({**r.get("config", {}), "data": r.get("data")} for r in (old, identity))
            raise other_configuration(out, "a fit", before, after, "other shards")
        # The description goes first: without it nothing counts as a finished material. The record stays until
        # it is replaced, so that a killed process leaves the folder of a fit.
        for name in (
            *(DESCRIPTION_NAME, DECODER_NAME, CONFIG_NAME, HISTORY_NAME, CHECKPOINT_NAME),
            *(WEIGHTS_NAME, TRANSMITTANCE_NAME, "layers.json", "textures.exr"),
        ):
            (out / name).unlink(missing_ok=True)
    make_folder(out)
    write_json(out / FIT_NAME, identity)
    write_text(out / CONFIG_NAME, dump_yaml(config.model_dump(mode="json")))
