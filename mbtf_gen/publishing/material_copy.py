"""A copy of the input files of a material, which gives the same data as the original."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mbtf_core.data.dataset import Dataset
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import file_sha256
from mbtf_gen.tile.loading import described, load_material

MATERIAL_FILE = "material.yaml"
# Keys of material files that name a file.
_NAMES = ("file", "filename", "mesh", "pattern", "curves")


@dataclass
class MaterialCopy:
    """The files of a material under names of one folder.

    Attributes
    ----------
    document : dict
        Content of its ``material.yaml``.
    files : dict of str to Path
        Name in the copy → original file.
    """

    document: dict[str, Any] = field(default_factory=dict)
    files: dict[str, Path] = field(default_factory=dict)

    def renamed(self, node: dict[str, Any], folder: Path) -> dict[str, Any]:
        """A material file with the names of the copy, whose own names are relative to a folder."""
        out: dict[str, Any] = {}
        for key, value in node.items():
            if isinstance(value, dict):
                out[key] = self.renamed(value, folder)
            else:
                named = key in _NAMES and isinstance(value, str)
                out[key] = self.add(folder / value) if named else value
        return out

    def add(self, source: Path) -> str:
        """Add a file under its own name; under a numbered one where another file has that.

        Raises
        ------
        InputError
            It is a mesh that consists of several files.
        """
        if _has_companions(source):
            raise InputError(
                "names other files, which the digests do not cover",
                where=source,
                hint="leave out --with-maps; a .glb holds everything in one file",
            )
        name, number = source.name, 1
        while name == MATERIAL_FILE or (
            name in self.files and file_sha256(self.files[name]) != file_sha256(source)
        ):
            number += 1
            name = f"{number}-{source.name}"
        self.files[name] = source
        return name


def copy_of_material(data: Dataset, moved: Path | None) -> MaterialCopy:
    """What to copy of the material of a data set.

    Parameters
    ----------
    data : Dataset
        Generated, not measured.
    moved : Path or None
        Path of the material, if it is not where the data set was generated from.

    Returns
    -------
    MaterialCopy

    Raises
    ------
    InputError
        The material cannot be read, has changed since, or consists of files that cannot be copied.
    """
    config = data.manifest["config"]
    path = Path(config["material"]) if moved is None else moved
    hint = "name it: --material PATH; or leave out --with-maps"
    try:
        material = load_material(path, config["geometry"]["make_tileable"])
        spec, folder, _ = described(path)
    except InputError as error:
        raise InputError(error.what, where=error.where, hint=error.hint or hint) from None
    if material.digests != data.manifest["inputs"]:
        raise InputError("has changed since the data set was made", where=path, hint=hint)
    copy = MaterialCopy()
    copy.document = copy.renamed(spec.model_dump(mode="json", exclude_unset=True), folder)
    return copy


def check_copy(data: Dataset, folder: Path) -> None:
    """An InputError unless the copy of a material in a folder gives the data set's own inputs."""
    material = load_material(folder / MATERIAL_FILE, data.manifest["config"]["geometry"]["make_tileable"])
    if material.digests != data.manifest["inputs"]:
        raise InputError(
            "its copy is read differently",
            where=folder / MATERIAL_FILE,
            hint="leave out --with-maps, and add the files of the material to recipe/ by hand",
        )


def _has_companions(path: Path) -> bool:
    """Whether a mesh consists of several files."""
    if path.suffix.lower() == ".obj":
        return any(line.startswith(b"mtllib") for line in path.read_bytes().splitlines())
    if path.suffix.lower() == ".gltf":
        document = json.loads(path.read_bytes())
        parts = [*document.get("buffers", []), *document.get("images", [])]
        return any(not str(part.get("uri", "data:")).startswith("data:") for part in parts)
    return False
