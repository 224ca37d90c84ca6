"""The recipe of a data set: configuration, digests, and a script that makes it again bit by bit."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from importlib.resources import files
from pathlib import Path

from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.data.dataset import Dataset
from mbtf_core.data.schema import CONFIG_NAME
from mbtf_core.files.atomic import Stored, write_chunks
from mbtf_gen.publishing.digests import DIGESTS_NAME, dataset_digests
from mbtf_gen.publishing.material_copy import MATERIAL_FILE, MaterialCopy
from mbtf_gen.publishing.npz import copy_file, public_config

RECIPE, SCRIPT_NAME, MATERIAL = "recipe", "remake.sh", "material"

# Name of a file in the folder → what writes it to a given path, atomically.
Makers = dict[str, Callable[[Path], Stored]]


def material_of(maps: bool) -> str:
    """The material in a command that runs in the published folder: its copy, or a word to replace."""
    return f"{RECIPE}/{MATERIAL}/{MATERIAL_FILE}" if maps else "MATERIAL"


def recipe_makers(data: Dataset, copy: MaterialCopy | None) -> Makers:
    """Writers of the files of a recipe, by file name.

    Parameters
    ----------
    data : Dataset
        A complete generated data set.
    copy : MaterialCopy or None
        The input files of the material, if they are published.

    Returns
    -------
    dict of str to callable
    """
    config = public_config(data.manifest)
    if copy is not None:
        config["material"] = f"{MATERIAL}/{MATERIAL_FILE}"
    makers: Makers = {
        f"{RECIPE}/{CONFIG_NAME}": _text(lambda: dump_yaml(config)),
        f"{RECIPE}/{DIGESTS_NAME}": _text(lambda: json.dumps(dataset_digests(data), indent=2) + "\n"),
        f"{RECIPE}/{SCRIPT_NAME}": _text(files(__package__).joinpath(SCRIPT_NAME).read_text),
    }
    if copy is not None:
        makers[f"{RECIPE}/{MATERIAL}/{MATERIAL_FILE}"] = _text(lambda: dump_yaml(copy.document))
        for name, source in sorted(copy.files.items()):
            makers[f"{RECIPE}/{MATERIAL}/{name}"] = partial(copy_file, source)
    return makers


def _text(content: Callable[[], str]) -> Callable[[Path], Stored]:
    return lambda path: write_chunks(path, [content().encode()])
