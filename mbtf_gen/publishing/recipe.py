"""The recipe of a data set: its configuration, digests of its files and, if published, its input files."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.data.dataset import Dataset
from mbtf_core.data.schema import CONFIG_NAME, GEOMETRY_NAME, MANIFEST_NAME
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import checksummed
from mbtf_core.images.limits import MAX_PIXELS
from mbtf_gen.tile.loading import described, load_material
from mbtf_gen.tile.mesh_file import COMPANION
from mbtf_gen.tile.protocol import Tile

# Folders of the recipe and of the material in the published folder.
RECIPE, MATERIAL = "recipe", "recipe/material"
_MATERIAL_FILE = "material.yaml"
MATERIAL_NAME = f"{MATERIAL}/{_MATERIAL_FILE}"
# Digests of the files that the recipe makes, as ``sha256sum --check`` reads them.
SUMS_NAME = f"{RECIPE}/SHA256SUMS"
# Keys of material files that name a file.
_NAMES = ("file", "filename", "mesh", "pattern", "curves")

# A file of the publication: its content, or the file that is copied.
Content = bytes | Path


def public_config(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration in a manifest with the bare name of the material, without the folders above it."""
    config = dict(manifest["config"])
    if "material" in config:
        config["material"] = Path(config["material"]).name or "material"
    return config


def public_documents(manifest: Mapping[str, Any]) -> dict[str, Content]:
    """Manifest and configuration of a published copy of the shards, by file name.

    The hash of the configuration does not cover the material's name, so that the sidecars stay valid.
    """
    config = public_config(manifest)
    text = dump_yaml(config).encode()
    digest = hashlib.sha256(text).hexdigest()
    return {
        MANIFEST_NAME: checksummed({**manifest, "config": config, "config_yaml": digest}),
        CONFIG_NAME: text,
    }


def is_yaml_alone(data: Dataset) -> bool:
    """Whether the material of a data set has no other files than its YAML: a weave or a knit."""
    return bool(data.manifest["inputs"].keys() == {"settings"})


def recipe_files(data: Dataset, *, with_maps: bool, moved: Path | None) -> dict[str, Content]:
    """Configuration, digests and, `with_maps`, material of generated data, by name in the published folder;
    an InputError if the material cannot be read, has changed since, or consists of files that cannot be
    copied.

    A weave or a knit is published in any case, where its YAML is unchanged. The material is at `moved`, if it
    is not where the data set was generated from.
    """
    config = public_config(data.manifest)
    shards = [shard for split in data.splits for shard in data.shards(split)]
    sums = {shard.file: str(shard.sidecar["sha256"]) for shard in shards}
    if (geometry := data.manifest["geometry"]) is not None:
        sums[GEOMETRY_NAME] = geometry["sha256"]
    lines = "".join(f"{digest}  {name}\n" for name, digest in sums.items())
    documents: dict[str, Content] = {SUMS_NAME: lines.encode()}
    without = documents | {f"{RECIPE}/{CONFIG_NAME}": dump_yaml(config).encode()}
    if not with_maps and not is_yaml_alone(data):
        return without
    path = Path(data.manifest["config"]["material"]) if moved is None else moved
    hint = "name it: --material PATH; or leave out --with-maps"
    try:
        tile = check_inputs(data, path, "has changed since the data set was made", hint)
    except InputError as error:
        if not with_maps:
            return without
        raise InputError(error.what, where=error.where, hint=error.hint or hint) from None
    if any(role.startswith(COMPANION) for role in tile.files):
        raise InputError(
            "names other files, which are not copied",
            where=tile.files["mesh"],
            hint="leave out --with-maps; a .glb holds everything in one file",
        )
    spec, folder, _ = described(path)
    files: dict[str, Content] = {}
    document = _copied(spec.model_dump(mode="json", exclude_unset=True), folder, "", files)
    config["material"] = f"{Path(MATERIAL).name}/{_MATERIAL_FILE}"
    return {
        **documents,
        f"{RECIPE}/{CONFIG_NAME}": dump_yaml(config).encode(),
        MATERIAL_NAME: dump_yaml(document).encode(),
        **{f"{MATERIAL}/{name}": source for name, source in files.items()},
    }


def check_inputs(data: Dataset, material: Path, what: str, hint: str) -> Tile:
    """The material, refused if it is not the one that a data set was generated from."""
    geometry = data.manifest["config"]["geometry"]
    tile = load_material(material, geometry["make_tileable"], geometry.get("max_pixels", MAX_PIXELS))
    if tile.digests != data.manifest["inputs"]:
        raise InputError(what, where=material, hint=hint)
    return tile


def _copied(node: dict[str, Any], folder: Path, role: str, files: dict[str, Content]) -> dict[str, Any]:
    """A material file that names copies, each in a folder of its role; adds them to `files`."""
    out: dict[str, Any] = {}
    for key, value in node.items():
        out[key] = value
        if isinstance(value, dict):
            out[key] = _copied(value, folder, f"{role}{key}/", files)
        elif key in _NAMES and isinstance(value, str):
            source = folder / value
            out[key] = f"{role or f'{key}/'}{source.name}"
            files[out[key]] = source
    return out
