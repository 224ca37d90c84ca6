"""A folder of shards as one data set: manifest, splits, sidecars, arrays."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from mbtf_core.atomic import read_json
from mbtf_core.config_file import check_document
from mbtf_core.errors import InputError
from mbtf_core.lattice import MAX_LEVEL, Lattice
from mbtf_core.shard_schema import ARRAYS, FORMAT_NAME, MANIFEST_NAME, SCHEMA_VERSION, Layout
from mbtf_core.suggest import suggest_path
from mbtf_gen.dataset.shard_io import Arrays, read_shard

_Count = Annotated[int, Field(strict=True, ge=0, lt=1 << 40)]
_FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*\.(npz|exr)$", max_length=100)]
_MAKE_AGAIN = "generate the data set again, or fetch it again from where it came"
# Bytes of a query in a shard.
_QUERY_BYTES = sum(max(1, sum(a.trailing)) * a.dtype.itemsize for a in ARRAYS if not a.optional)


class _Entry(BaseModel):
    file: _FileName
    rows: _Count


class _Split(BaseModel):
    shards: list[_Entry]


class _Levels(BaseModel):
    finest: Annotated[int, Field(strict=True, ge=0, le=MAX_LEVEL)]


class _Tile(BaseModel):
    aspect: float = Field(gt=0, le=1e6, allow_inf_nan=False)


class _Manifest(BaseModel):
    """What readers of a manifest rely on; it holds more."""

    config_hash: str
    layout: Layout
    levels: _Levels
    tile: _Tile
    splits: dict[str, _Split]
    patch_size: _Count | None = None


class _Sidecar(BaseModel):
    """What readers of a shard's sidecar rely on; it holds more."""

    rows: _Count


@dataclass(frozen=True)
class Shard:
    """One finished shard: its files and what its sidecar says."""

    path: Path
    sidecar: dict[str, Any]

    @property
    def rows(self) -> int:
        """Queries in the shuffled layout, images in the image layout."""
        return int(self.sidecar["rows"])


@dataclass(frozen=True)
class Dataset:
    """A data set made by ``mbtf-gen``.

    Attributes
    ----------
    folder : where it lies
    manifest : content of ``manifest.json``
    """

    folder: Path
    manifest: dict[str, Any]

    @classmethod
    def open(cls, folder: str | Path) -> Dataset:
        """Open a folder of shards.

        Raises
        ------
        InputError : no manifest, another format, another schema version, or keys that are missing or hold
            something else
        """
        folder = Path(folder)
        if not folder.is_dir():
            raise InputError("no such folder", where=folder, hint=suggest_path(folder, Path.is_dir))
        path = folder / MANIFEST_NAME
        if not path.exists():
            raise InputError(
                f"no {MANIFEST_NAME} in it", where=folder, hint="make one: mbtf-gen heightfield.exr -o FOLDER"
            )
        manifest = read_json(path)
        if manifest.get("format") != FORMAT_NAME:
            raise InputError(f"is not a manifest of {FORMAT_NAME}", where=path)
        if manifest.get("schema") != SCHEMA_VERSION:
            raise InputError(
                f"shards of schema {manifest.get('schema')}; this version reads schema {SCHEMA_VERSION}",
                where=path,
                hint="generate them again with this version of mbtf-gen",
            )
        check_document(_Manifest, manifest, path, _MAKE_AGAIN)
        return cls(folder, manifest)

    @property
    def layout(self) -> Layout:
        """``shuffled`` or ``image``."""
        layout: Layout = self.manifest["layout"]
        return layout

    @property
    def patch_size(self) -> int | None:
        """Texels along each side of an image; None: images cover the whole finest level."""
        size: int | None = self.manifest.get("patch_size")
        return size

    @property
    def lattice(self) -> Lattice:
        """Texel grids of the tile."""
        return Lattice(int(self.manifest["levels"]["finest"]), float(self.manifest["tile"]["aspect"]))

    @property
    def splits(self) -> list[str]:
        """Names of the splits, ``train`` and ``test`` as a rule."""
        return list(self.manifest["splits"])

    def shards(self, split: str) -> list[Shard]:
        """Shards of a split in order.

        Raises
        ------
        InputError : no such split, a shard that the manifest lists is missing, or a damaged sidecar
        """
        if split not in self.manifest["splits"]:
            raise InputError(f"has no split '{split}' (it has: {', '.join(self.splits)})", where=self.folder)
        out = []
        for entry in self.manifest["splits"][split]["shards"]:
            path = self.folder / entry["file"]
            sidecar = path.with_suffix(".json")
            if not path.exists() or not sidecar.exists():
                raise InputError(
                    f"shard {entry['file']} is missing or unfinished",
                    where=self.folder,
                    hint="run the mbtf-gen command that made the folder again: it resumes",
                )
            record = read_json(sidecar)
            check_document(_Sidecar, record, sidecar, _MAKE_AGAIN)
            if record["rows"] * _QUERY_BYTES > path.stat().st_size:
                raise InputError(
                    f"is too short for the {record['rows']} rows that its sidecar says",
                    where=path,
                    hint="look for damage with: mbtf-gen verify",
                )
            out.append(Shard(path, record))
        return out

    def iterate(self, split: str, names: Iterable[str] | None = None) -> Iterator[Arrays]:
        """Arrays of each shard of a split in turn, memory-mapped where the format allows."""
        wanted = None if names is None else list(names)
        for shard in self.shards(split):
            yield read_shard(shard.path, wanted)

    def load(self, split: str, names: Iterable[str] | None = None) -> Arrays:
        """All queries of a split in memory, leading axis the query (or image)."""
        parts = list(self.iterate(split, names))
        if not parts:
            raise InputError(f"split '{split}' has no shards", where=self.folder)
        return {name: _concatenate([p[name] for p in parts]) for name in parts[0]}


def _concatenate(parts: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    return np.concatenate(parts, axis=0)
