"""Publishes a data set: writes a folder that is ready for a data hub."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from mbtf_core.data.dataset import Dataset, Shard
from mbtf_core.data.folder import DataFolder, sidecar_name
from mbtf_core.data.schema import GEOMETRY_NAME
from mbtf_core.data.verify import verify
from mbtf_core.errors import EngineError, InputError, UsageError
from mbtf_core.files.atomic import Stored, data_sha256, write_chunks
from mbtf_core.files.folders import OutputFolder, OutputKind, check_space, owned
from mbtf_gen.config.publish import PublishConfig
from mbtf_gen.publishing.card import CARD_NAME, card_text
from mbtf_gen.publishing.croissant import CROISSANT_NAME, croissant_text
from mbtf_gen.publishing.facts import DATA, Facts
from mbtf_gen.publishing.material_copy import MaterialCopy, check_copy, copy_of_material
from mbtf_gen.publishing.npz import copy_file, link_or_copy, public_documents
from mbtf_gen.publishing.parquet import write_parquet
from mbtf_gen.publishing.picture import PICTURE_NAME, write_picture
from mbtf_gen.publishing.recipe import MATERIAL, RECIPE, Makers, recipe_makers
from mbtf_gen.publishing.webdataset import write_tar

PUBLICATION = OutputKind("publish.json", "mbtf-publication", 2, "a published data set")
# Bytes of picture, card and documents.
_DOCUMENT_BYTES = 4 << 20
# Library that writes each form.
_LIBRARIES = {"parquet": "pyarrow", "webdataset": "webdataset", "npz": "mlcroissant"}


@dataclass(frozen=True)
class Publication:
    """A data set to publish.

    Parameters
    ----------
    facts : Facts
        A complete data set, and what its publishers say.
    copy : MaterialCopy or None
        The input files of the material, if they are published.
    """

    facts: Facts
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
            A library is missing.
        """
        data = Dataset.open(shards)
        for library in ("mlcroissant", _LIBRARIES[config.form]):
            if importlib.util.find_spec(library) is None:
                hint = "pip install 'mbtf[publish]'"
                raise EngineError(f"{library} is not installed", where=f"--form {config.form}", hint=hint)
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
        return cls(Facts(data, config), copy_of_material(data, material) if with_maps else None)

    @property
    def size(self) -> int:
        """Bytes that the folder takes at most."""
        data = self.facts.data
        shards = sum(int(s.sidecar["bytes"]) for found in self.facts.shards.values() for s in found)
        surface = data.folder.size(GEOMETRY_NAME) or 0
        maps = sum(path.stat().st_size for path in self.copy.files.values()) if self.copy else 0
        # Tar files have a header and up to a block of padding per array.
        return round(1.02 * shards) + surface + maps + _DOCUMENT_BYTES

    @property
    def depends(self) -> dict[str, Any]:
        """Plain data that determine the content of the folder."""
        config = self.facts.config
        stored = {s.file: s.sidecar["sha256"] for found in self.facts.shards.values() for s in found}
        return {
            **config.model_dump(mode="json", exclude={"version"}),
            # A long text would make a long message.
            "citation": None if config.citation is None else data_sha256(config.citation),
            "with_maps": self.copy is not None,
            "config_hash": self.facts.data.manifest["config_hash"],
            "shards": data_sha256(stored),
        }

    @cached_property
    def makers(self) -> Makers:
        """Writers of all files but the card and ``croissant.json``, by name."""
        data = self.facts.data
        makers: Makers = {}
        for found in self.facts.shards.values():
            for shard in found:
                makers |= self._shard_makers(shard)
        if (geometry := data.manifest["geometry"]) is not None:
            makers[f"{DATA}/{GEOMETRY_NAME}"] = lambda path: copy_file(
                data.folder.file(GEOMETRY_NAME, geometry["sha256"]), path
            )
        if self.facts.config.form == "npz":
            for name, content in public_documents(data.manifest).items():
                makers[f"{DATA}/{name}"] = partial(write_chunks, chunks=[content])
        if not self.facts.measured:
            makers |= recipe_makers(data, self.copy)
        makers[PICTURE_NAME] = partial(write_picture, data)
        return makers

    def _shard_makers(self, shard: Shard) -> Makers:
        stem, form = shard.file.rpartition(".")[0], self.facts.config.form
        if form == "parquet":
            described = self.facts.data.manifest["arrays"]
            return {f"{DATA}/{stem}.parquet": lambda path: write_parquet(path, shard.read(), described)}
        if form == "webdataset":
            return {f"{DATA}/{stem}.tar": lambda path: write_tar(path, shard.read())}
        sidecar = sidecar_name(shard.file)
        return {
            f"{DATA}/{shard.file}": lambda path: link_or_copy(shard.local(), path),
            f"{DATA}/{sidecar}": lambda path: write_chunks(path, [shard.folder.read(sidecar)]),
        }

    def write(
        self, output: Path, *, overwrite: bool = False, progress: Callable[[float], None] = lambda _: None
    ) -> dict[str, Stored]:
        """Write the folder, or finish an unfinished one.

        Parameters
        ----------
        output : Path
            Folder to write.
        overwrite : bool
            Replace what was published there.
        progress : callable
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
        with owned(output):
            listed = [*self.makers, CARD_NAME, CROISSANT_NAME]
            folder = OutputFolder.claim(output, PUBLICATION, self.depends, listed, overwrite=overwrite)
            written = {}
            for name, maker in self.makers.items():
                written[name] = folder.add(name, maker)
                progress(1)
            files = dict(sorted(written.items()))
            if self.copy is not None:
                check_copy(self.facts.data, output / RECIPE / MATERIAL)
            maps = self.copy is not None
            card, croissant = card_text(self.facts, files, maps), croissant_text(self.facts, files)
            for name, text in ((CARD_NAME, card), (CROISSANT_NAME, croissant)):
                files[name] = folder.add(name, partial(write_chunks, chunks=[text.encode()]))
            return dict(sorted(files.items()))
