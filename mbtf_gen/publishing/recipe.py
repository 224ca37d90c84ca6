"""The recipe of a data set: configuration, digests, and a script that makes it again bit by bit."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.data.dataset import Dataset
from mbtf_core.data.schema import CONFIG_NAME
from mbtf_core.files.atomic import Stored, write_chunks
from mbtf_gen.publishing.digests import DIGESTS_NAME, dataset_digests
from mbtf_gen.publishing.folder import RECIPE
from mbtf_gen.publishing.maps import MATERIAL_FILE, MaterialCopy
from mbtf_gen.publishing.shards import copy_file, public_config

SCRIPT_NAME = "remake.sh"
MATERIAL = "material"
# Beside the published folder, so that it is not uploaded with it.
DEFAULT_OUTPUT = "remade"
_SCRIPT = """\
#!/bin/sh
# Makes the data set again and compares every array with the published one.
# Usage: sh {script} {usage}
# FOLDER is by default {default}, beside the published folder.
set -eu
recipe=$(dirname "$0")
{begin}
mbtf-gen "$material" --config "$recipe/{config}" -o "$folder"
mbtf-gen verify "$folder" --digests "$recipe/{digests}"
"""
_WITH_MAPS = f"""\
material="$recipe/{MATERIAL}/{MATERIAL_FILE}"
folder="${{1:-$recipe/../../{DEFAULT_OUTPUT}}}\""""
_WITHOUT_MAPS = f"""\
if [ $# -lt 1 ]; then echo "error: name the material: sh $0 MATERIAL [FOLDER]" >&2; exit 2; fi
material="$1"
folder="${{2:-$recipe/../../{DEFAULT_OUTPUT}}}\""""


def remake_script(maps: bool) -> str:
    """The script, with the material beside it or with its path as the first argument."""
    return _SCRIPT.format(
        script=SCRIPT_NAME,
        default=DEFAULT_OUTPUT,
        usage="[FOLDER]" if maps else "MATERIAL [FOLDER]",
        begin=_WITH_MAPS if maps else _WITHOUT_MAPS,
        config=CONFIG_NAME,
        digests=DIGESTS_NAME,
    )


def remake_call(maps: bool) -> str:
    """The call of the script in the published folder."""
    return f"sh {RECIPE}/{SCRIPT_NAME}" + ("" if maps else " MATERIAL")


def remake_commands(maps: bool) -> list[str]:
    """The two commands of the script, as one gives them in the published folder."""
    material = f"{RECIPE}/{MATERIAL}/{MATERIAL_FILE}" if maps else "MATERIAL"
    return [
        f"mbtf-gen {material} --config {RECIPE}/{CONFIG_NAME} -o ../{DEFAULT_OUTPUT}/",
        f"mbtf-gen verify ../{DEFAULT_OUTPUT}/ --digests {RECIPE}/{DIGESTS_NAME}",
    ]


def recipe_makers(data: Dataset, copy: MaterialCopy | None) -> dict[str, Callable[[Path], Stored]]:
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
    makers: dict[str, Callable[[Path], Stored]] = {
        f"{RECIPE}/{CONFIG_NAME}": _text(lambda: dump_yaml(config)),
        f"{RECIPE}/{DIGESTS_NAME}": _text(lambda: json.dumps(dataset_digests(data), indent=2) + "\n"),
        f"{RECIPE}/{SCRIPT_NAME}": _text(lambda: remake_script(copy is not None)),
    }
    if copy is not None:
        makers[f"{RECIPE}/{MATERIAL}/{MATERIAL_FILE}"] = _text(lambda: copy.text)
        for name, source in sorted(copy.files.items()):
            makers[f"{RECIPE}/{MATERIAL}/{name}"] = partial(copy_file, source)
    return makers


def _text(content: Callable[[], str]) -> Callable[[Path], Stored]:
    return lambda path: write_chunks(path, [content().encode()])
