"""A folder of shards as one data set: manifest, splits, sidecars, arrays."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np

from mbtf_core.config.settings import check_document, check_schema
from mbtf_core.config.yaml_file import shortened
from mbtf_core.data.documents import ABSENT, CHANGED, Manifest, read_sidecar, repair_hint
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.geometry import Geometry, read_geometry
from mbtf_core.data.lattice import Lattice
from mbtf_core.data.schema import ARRAY, FORMAT_NAME, MANIFEST_NAME, SCHEMA_VERSION, Layout, ShardEntry, Split
from mbtf_core.data.shard_files import Arrays, check_values, column_means, read_shard
from mbtf_core.errors import InputError, check_type
from mbtf_core.files.atomic import file_sha256
from mbtf_core.paths import suggest_path

_MAKE_AGAIN = "generate or download the data set again"
# Times that a shard is downloaded again because it has left the cache.
_READS = 8
# The sidecar's mean and that of the shard are float64 sums in different orders.
_SAME_MEAN = 1e-7


@dataclass(frozen=True)
class Shard:
    """One finished shard.

    Attributes
    ----------
    folder : the data set that it belongs to
    file : name of its file
    sidecar : the content of its sidecar
    image : rows and columns of an image in the image layout, the number of directions in the slices layout;
        empty in the shuffled layout
    estimates : independent estimates of every value: 2, or 1 of measured data
    weighted : whether its queries have weights, the array ``weight``
    """

    folder: DataFolder
    file: str
    sidecar: dict[str, Any]
    image: tuple[int, ...] = ()
    estimates: int = 2
    weighted: bool = False

    @property
    def rows(self) -> int:
        """Queries in the shuffled layout, images in the image layout, positions in the slices layout."""
        return int(self.sidecar["rows"])

    @property
    def where(self) -> str:
        """Path or URL of its file, for messages."""
        return self.folder.at(self.file)

    def local(self) -> Path:
        """A local file with its content: itself, or a checked copy in the cache.

        Raises
        ------
        InputError : it is missing, or not the shard that its sidecar describes
        PartialError : its store cannot be reached, or the disk is full
        """
        return self.folder.file(self.file, str(self.sidecar["sha256"]), int(self.sidecar["bytes"]))

    def map(self, names: Iterable[str] | None = None) -> Arrays:
        """Its arrays, memory-mapped if the format allows, their numbers unchecked; see :meth:`read`."""
        wanted = None if names is None else list(names)
        for last in (*[False] * _READS, True):
            path = self.local()
            try:
                return read_shard(path, wanted)
            except InputError as error:
                # Other readers may have made room in the cache before it was opened.
                if last or path.exists() or not self.folder.has(self.file):
                    raise InputError(error.what, where=self.where, hint=error.hint) from None
        raise AssertionError

    def read(self, names: Iterable[str] | None = None) -> Arrays:
        """Its arrays, memory-mapped if the format allows, every number checked.

        Parameters
        ----------
        names : arrays to read; all by default

        Raises
        ------
        InputError : it cannot be read, its numbers are invalid, or they are those of another shard. Its size
            and its rows are compared with the sidecar's, and where both values are read, their mean. Without
            the values, the numbers of a shard that was copied over another of the same size are returned;
            ``mbtf-gen verify`` compares digests and finds it
        """
        arrays = self.map(names)
        hint = f"check the data set with: mbtf-gen verify {self.folder}"
        for name, array in arrays.items():
            rows, image = len(array), array.shape[1 : array.ndim - len(ARRAY[name].trailing)]
            if rows != self.rows:
                what = f"has {rows} rows, its sidecar says {self.rows}"
                raise InputError(what, where=self.where, hint=hint)
            if image != self.image:
                found, expected = (" x ".join(map(str, s)) or "1" for s in (image, self.image))
                what = f"has {found} queries per row, {MANIFEST_NAME} says {expected}"
                raise InputError(what, where=self.where, hint=hint)
        try:
            check_values(arrays, self.where)
        except InputError as error:
            raise InputError(error.what, where=self.where, hint=hint) from None
        halves = ("value_a", "value_b")[: self.estimates]
        if self.rows and all(name in arrays for name in halves):
            mean = np.mean([column_means(arrays[name]) for name in halves], axis=0)
            stated = np.asarray(self.sidecar["statistics"]["mean_value"])
            if np.abs(mean - stated).max() > _SAME_MEAN * np.abs(stated).max():
                raise InputError("is not the shard that its sidecar describes", where=self.where, hint=hint)
        return arrays


def is_dataset(folder: str | Path | DataFolder) -> bool:
    """Whether a folder contains a data set, possibly without its manifest."""
    found = folder if isinstance(folder, DataFolder) else DataFolder.open(folder)
    return found.has(MANIFEST_NAME) or bool(found.sidecars())


@dataclass(frozen=True)
class Dataset:
    """A data set generated by ``mbtf-gen``; :meth:`open` makes it.

    Attributes
    ----------
    folder : its files
    manifest : the content of ``manifest.json``
    """

    folder: DataFolder
    manifest: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        hint = f"open it: Dataset.open({shortened(self.folder)})"
        check_type(self.folder, DataFolder, "the folder of a Dataset", hint)

    @classmethod
    def open(cls, folder: str | Path | DataFolder, cache: float | None = None) -> Dataset:
        """Open a folder of shards.

        Parameters
        ----------
        folder : the data set: a path, or a URL such as ``s3://bucket/data``
        cache : bytes of local disk for shards of object stores; 20 GB by default

        Raises
        ------
        InputError : no manifest, another format or schema version, or invalid keys
        PartialError : the store cannot be reached
        """
        folder = DataFolder.open(folder)
        if cache is not None:
            folder.cache.limit = cache
        if not folder.exists():
            raise InputError("no such folder", where=folder, hint=suggest_path(folder.workspace, Path.is_dir))
        hint = repair_hint(folder)
        if not folder.has(MANIFEST_NAME):
            hint = hint if is_dataset(folder) else "generate one: mbtf-gen heightfield.exr -o FOLDER"
            raise InputError(f"no {MANIFEST_NAME} in it", where=folder, hint=hint)
        path = folder.at(MANIFEST_NAME)
        manifest = folder.read_json(MANIFEST_NAME, hint)
        if manifest.get("format") != FORMAT_NAME:
            hint = hint if folder.sidecars() else ""
            raise InputError(f"is not a manifest of {FORMAT_NAME}", where=path, hint=hint)
        if manifest.get("schema") == SCHEMA_VERSION or "checksum" in manifest:
            folder.read_checksummed(MANIFEST_NAME, hint)
        check_schema(
            manifest, SCHEMA_VERSION, path, "generate the shards again with this version of mbtf-gen"
        )
        check_document(Manifest, manifest, path, _MAKE_AGAIN)
        return cls(folder, manifest)

    def __repr__(self) -> str:
        splits = ", ".join(f"{found['queries']} {name}" for name, found in self.manifest["splits"].items())
        return (
            f"<Dataset {self.folder}: {splits} queries, {self.layout}, resolution {self.lattice.shape()[1]}>"
        )

    @property
    def layout(self) -> Layout:
        """``shuffled``, ``image`` or ``slices``."""
        layout: Layout = self.manifest["layout"]
        return layout

    @property
    def patch_size(self) -> int | None:
        """Texels along each side of an image; None: images cover the whole finest level."""
        size: int | None = self.manifest.get("patch_size")
        return size

    def lights_per_path(self, split: str) -> int:
        """Queries of a group that share paths, position, footprint and view: in a shard of n, the queries
        i, i + n/L, i + 2n/L, …"""
        return int(self.manifest["splits"][split].get("lights_per_path", 1))

    @property
    def estimates(self) -> int:
        """Independent estimates of every value: 2, or 1 of measured data, which have no array ``value_b``."""
        return int(self.manifest.get("estimates", 2))

    @property
    def light_width(self) -> float | None:
        """RMS angle per axis of the light kernel, in degrees; None where the data set does not say."""
        width = ((self.manifest.get("config") or {}).get("light") or {}).get("width")
        return None if width is None else float(width)

    @property
    def weighted(self) -> bool:
        """Whether test queries have weights, the array ``weight``."""
        return "weight" in self.manifest.get("arrays", {})

    @property
    def lattice(self) -> Lattice:
        """Texel grids of the tile."""
        return Lattice(int(self.manifest["levels"]["finest"]), float(self.manifest["tile"]["aspect"]))

    @property
    def splits(self) -> list[str]:
        """Names of the splits, usually ``train`` and ``test``."""
        return list(self.manifest["splits"])

    def entries(self, split: str) -> list[ShardEntry]:
        """Shards that the manifest lists for a split, finished or not."""
        listed = self.manifest["splits"].get(split, {"shards": []})["shards"]
        return [ShardEntry(cast(Split, split), i, e["file"], e["rows"]) for i, e in enumerate(listed)]

    def shards(self, split: str) -> list[Shard]:
        """Shards of a split in order.

        Parameters
        ----------
        split : ``train`` or ``test``

        Raises
        ------
        InputError : no such split, a missing shard, a corrupt sidecar, or a shard that is not the one listed
        """
        if split not in self.manifest["splits"]:
            raise InputError(f"has no split '{split}' (it has: {', '.join(self.splits)})", where=self.folder)
        image: tuple[int, ...] = ()
        if self.layout == "image":
            image = self.lattice.shape() if self.patch_size is None else (self.patch_size,) * 2
        elif self.layout == "slices":
            image = (int(self.manifest["slice_size"] or 1) if split == "train" else 1,)
        out = []
        for entry in self.entries(split):
            try:
                record = read_sidecar(self.folder, entry, self.manifest["config_hash"])
            except InputError as error:
                if error.what in ABSENT:
                    raise InputError(
                        f"shard {entry.file} is missing or unfinished",
                        where=self.folder,
                        hint="run the mbtf-gen command that generated it again: it resumes",
                    ) from None
                hint = f"check the data set with: mbtf-gen verify {self.folder}"
                raise InputError(error.what, where=self.folder.at(entry.file), hint=hint) from None
            weighted = self.weighted and entry.split == "test"
            out.append(Shard(self.folder, entry.file, record, image, self.estimates, weighted))
        return out

    def geometry(self) -> Geometry | None:
        """Heights, slopes and reflectance of the surface, their digest checked.

        Returns
        -------
        Geometry or None
            None where the data set has none.

        Raises
        ------
        InputError : the file is missing or is not the one that was written
        """
        record = self.manifest["geometry"]
        if record is None:
            return None
        name, hint = record["file"], repair_hint(self.folder)
        where = self.folder.at(name)
        if not self.folder.has(name):
            raise InputError(ABSENT[0], where=where, hint=hint)
        path = self.folder.file(name, record["sha256"])
        try:
            changed = file_sha256(path) != record["sha256"]
        except OSError as error:
            raise InputError(f"cannot be read ({error.strerror})", where=where) from None
        if changed:
            raise InputError(CHANGED, where=where, hint=hint)
        return read_geometry(path)

    def iterate(self, split: str, names: Iterable[str] | None = None) -> Iterator[Arrays]:
        """Arrays of each shard of a split in turn, memory-mapped if the format allows.

        Parameters
        ----------
        split : ``train`` or ``test``
        names : arrays to read; all by default

        Yields
        ------
        dict of str to float32 array
            The first axis is the query, or the image in the image layout.

        Raises
        ------
        InputError : see :meth:`shards` and :meth:`Shard.read`
        """
        wanted = None if names is None else [names] if isinstance(names, str) else list(names)
        yield from (shard.read(wanted) for shard in self.shards(split))

    def load(self, split: str = "train", names: Iterable[str] | None = None) -> Arrays:
        """All queries of a split in memory: ``Dataset.open("small").load("test")``.

        Parameters
        ----------
        split : ``train`` or ``test``
        names : arrays to read; all by default

        Returns
        -------
        dict of str to float32 array
            The first axis is the query, or the image in the image layout.

        Raises
        ------
        InputError : see :meth:`iterate`; or the split has no shards
        """
        check_type(self, Dataset, "Dataset.load", f"open it first: Dataset.open({shortened(self)}).load()")
        parts = list(self.iterate(split, names))
        if not parts:
            raise InputError(f"split '{split}' has no shards", where=self.folder)
        return {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
