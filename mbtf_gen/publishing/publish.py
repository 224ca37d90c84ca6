"""Publishes a data set: writes a folder that is ready for a data hub."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from mbtf_core.data.dataset import Dataset, Shard
from mbtf_core.data.folder import DataFolder, sidecar_name
from mbtf_core.data.schema import GEOMETRY_NAME
from mbtf_core.data.verify import verify
from mbtf_core.errors import InputError, UsageError
from mbtf_core.files.atomic import Stored, write_chunks
from mbtf_core.files.digest import data_sha256
from mbtf_core.files.folders import check_space, owned
from mbtf_gen.config.publish import PublishConfig
from mbtf_gen.publishing.card import CARD_NAME, Card
from mbtf_gen.publishing.croissant import CROISSANT_NAME, croissant_text
from mbtf_gen.publishing.facts import Facts
from mbtf_gen.publishing.folder import DATA, PICTURES, RECIPE, PublishFolder
from mbtf_gen.publishing.maps import MaterialCopy, check_copy, copy_of_material
from mbtf_gen.publishing.parquet import check_pyarrow, write_parquet
from mbtf_gen.publishing.pictures import picture_makers
from mbtf_gen.publishing.recipe import MATERIAL, recipe_makers
from mbtf_gen.publishing.shards import copy_file, link_or_copy, public_documents
from mbtf_gen.publishing.statistics import SplitStatistics, split_statistics
from mbtf_gen.publishing.webdataset import write_tar

# Bytes of pictures, card and documents.
_DOCUMENT_BYTES = 4 << 20

Makers = dict[str, Callable[[Path], Stored]]


@dataclass(frozen=True)
class Publication:
    """A data set to publish.

    Parameters
    ----------
    data : Dataset
        A complete data set.
    config : PublishConfig
        What its publishers say.
    copy : MaterialCopy or None
        The input files of the material, if they are published.
    """

    data: Dataset
    config: PublishConfig
    copy: MaterialCopy | None = None

    @classmethod
    def prepare(
        cls,
        shards: str | Path | DataFolder,
        config: PublishConfig,
        *,
        with_maps: bool = False,
        material: Path | None = None,
    ) -> Publication:
        """Check everything that is published, without writing anything.

        Parameters
        ----------
        shards : str, Path or DataFolder
            Folder of shards.
        config : PublishConfig
            What its publishers say.
        with_maps : bool
            Publish the input files of the material.
        material : Path or None
            Path of the material, if it was moved.

        Returns
        -------
        Publication

        Raises
        ------
        InputError
            The data set is damaged or unfinished, or its material cannot be copied.
        UsageError
            Options contradict the data set.
        EngineError
            The library of the file format is missing.
        """
        data = Dataset.open(shards)
        if config.form == "parquet":
            check_pyarrow()
        if config.form == "npz" and data.manifest["array_format"] != "npz":
            raise UsageError(
                f"{data.folder} holds shards of another format ({data.manifest['array_format']})",
                where="--form npz",
                hint="use --form parquet or --form webdataset",
            )
        if (with_maps or material is not None) and "measured" in data.manifest:
            raise UsageError(f"{data.folder} holds measured data, without maps", where="--with-maps")
        if material is not None and not with_maps:
            raise UsageError("goes with --with-maps", where="--material")
        for fault in verify(data.folder):
            raise InputError(fault.what, where=data.folder.at(fault.file), hint=fault.hint)
        return cls(data, config, copy_of_material(data, material) if with_maps else None)

    @cached_property
    def facts(self) -> Facts:
        """What manifest and publishers say."""
        return Facts(self.data, self.config)

    @cached_property
    def shards(self) -> dict[str, list[Shard]]:
        """Shards of each split that has any."""
        found = {split: self.data.shards(split) for split in self.data.splits}
        return {split: shards for split, shards in found.items() if shards}

    @cached_property
    def splits(self) -> dict[str, dict[str, dict[str, Any]]]:
        """Fields of each split."""
        return {split: self.facts.fields(shards[0].read()) for split, shards in self.shards.items()}

    @cached_property
    def statistics(self) -> Mapping[str, SplitStatistics]:
        """Statistics of each split."""
        return {split: split_statistics(self.data, split) for split in self.shards}

    @property
    def size(self) -> int:
        """Bytes that the folder takes at most."""
        shards = sum(int(shard.sidecar["bytes"]) for found in self.shards.values() for shard in found)
        surface = self.data.folder.size(GEOMETRY_NAME) or 0
        maps = sum(path.stat().st_size for path in self.copy.files.values()) if self.copy else 0
        # Tar files have a header and up to a block of padding per array.
        return round(1.02 * shards) + surface + maps + _DOCUMENT_BYTES

    @property
    def depends(self) -> dict[str, Any]:
        """Plain data that determine the content of the folder."""
        stored = {shard.file: shard.sidecar["sha256"] for found in self.shards.values() for shard in found}
        options = self.config.model_dump(mode="json", exclude={"version"})
        # A long text would make a long message.
        citation = None if self.config.citation is None else data_sha256(self.config.citation)
        return {
            **options,
            "citation": citation,
            "with_maps": self.copy is not None,
            "config_hash": self.data.manifest["config_hash"],
            "shards": data_sha256(stored),
        }

    def _data_makers(self) -> Makers:
        makers: Makers = {}
        for found in self.shards.values():
            for shard in found:
                makers |= self._shard_makers(shard)
        if (geometry := self.data.manifest["geometry"]) is not None:
            makers[f"{DATA}/{GEOMETRY_NAME}"] = lambda path: copy_file(
                self.data.folder.file(GEOMETRY_NAME, geometry["sha256"]), path
            )
        if self.config.form == "npz":
            for name, content in public_documents(self.data.manifest).items():
                makers[f"{DATA}/{name}"] = partial(_write, content)
        return makers

    def _shard_makers(self, shard: Shard) -> Makers:
        stem, form = shard.file.rpartition(".")[0], self.config.form
        if form == "parquet":
            facts = {"layout": self.data.layout, "split": shard.sidecar["split"]}
            described = self.data.manifest["arrays"]
            return {
                f"{DATA}/{stem}.parquet": lambda path: write_parquet(path, shard.read(), described, facts)
            }
        if form == "webdataset":
            return {f"{DATA}/{stem}.tar": lambda path: write_tar(path, shard.read())}
        sidecar = sidecar_name(shard.file)
        return {
            f"{DATA}/{shard.file}": lambda path: link_or_copy(shard.local(), path),
            f"{DATA}/{sidecar}": lambda path: _write(shard.folder.read(sidecar), path),
        }

    def makers(self) -> Makers:
        """Writers of all files but the card and ``croissant.json``, by name."""
        pictures = picture_makers(self.data, lambda: self.statistics)
        recipe = {} if self.facts.measured else recipe_makers(self.data, self.copy)
        return {
            **self._data_makers(),
            **recipe,
            **{f"{PICTURES}/{name}": maker for name, maker in pictures.items()},
        }

    def write(
        self, output: Path, *, overwrite: bool = False, progress: Callable[[float], None] | None = None
    ) -> dict[str, Stored]:
        """Write the folder, or finish an unfinished one.

        Parameters
        ----------
        output : Path
            Folder to write.
        overwrite : bool
            Replace what was published there.
        progress : callable, optional
            Called with 1 after each file.

        Returns
        -------
        dict of str to Stored
            The files by name.

        Raises
        ------
        InputError
            The folder holds something else, or does not fit on the disk.
        PartialError
            It cannot be written, or another process writes to it; the same command resumes.
        """
        check_space(output, self.size, "choose another folder with -o")
        makers = self.makers()
        with owned(output):
            listed = [*makers, CARD_NAME, CROISSANT_NAME]
            folder = PublishFolder.claim(output, self.depends, listed, overwrite=overwrite)
            for name, maker in makers.items():
                folder.add(name, maker)
                if progress is not None:
                    progress(1)
            if self.copy is not None:
                check_copy(self.data, output / RECIPE / MATERIAL)
            files = {name: stored for name, stored in folder.files.items() if name in makers}

            def card() -> str:
                return Card(self.facts, self.splits, self.statistics, files, self.copy is not None).text

            folder.add(CARD_NAME, lambda path: _write(card().encode(), path))
            document = croissant_text(self.facts, files, self.splits)
            folder.add(CROISSANT_NAME, partial(_write, document.encode()))
            return folder.files


def _write(content: bytes, path: Path) -> Stored:
    return write_chunks(path, [content])
