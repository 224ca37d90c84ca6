"""Publishes a data set: writes a folder that is ready for a data hub."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.data.dataset import Dataset, Shard
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.schema import GEOMETRY_NAME
from mbtf_core.data.shard_files import Arrays
from mbtf_core.data.verify import verify
from mbtf_core.errors import InputError, UsageError
from mbtf_core.extras import extra_error, has_extra
from mbtf_core.files.atomic import Stored, data_sha256, write_chunks
from mbtf_core.files.folders import OutputFolder, OutputKind, check_space, owned
from mbtf_gen.config.exchange import PublishConfig
from mbtf_gen.publishing.card import CARD_NAME, card_text
from mbtf_gen.publishing.croissant import CROISSANT_NAME, croissant_text
from mbtf_gen.publishing.facts import Facts, name_of
from mbtf_gen.publishing.formats import copied, published_names, shard_writers
from mbtf_gen.publishing.picture import PICTURE_NAME, write_picture
from mbtf_gen.publishing.recipe import (
    MATERIAL,
    MATERIAL_NAME,
    Content,
    check_inputs,
    public_documents,
    recipe_files,
)

PUBLICATION = OutputKind("publish.json", "mbtf-publication", 4, "a published data set")
# Bytes of picture, card and documents.
_DOCUMENT_BYTES = 4 << 20
# Queries of a split that the statistics are of, at most.
_SAMPLE = 1 << 20


@dataclass(frozen=True)
class Publication:
    """A data set to publish.

    Parameters
    ----------
    data : a complete data set
    config : what its publishers say
    documents : geometry, recipe and copies of documents, by name in the folder
    maps : whether the input files of the material are published
    """

    data: Dataset
    config: PublishConfig
    documents: dict[str, Content]
    maps: bool = False

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
        with_maps : publish the input files of the material
        material : path of the material, if it was moved

        Raises
        ------
        InputError : the data set is damaged or unfinished, or its material cannot be copied
        UsageError : options contradict the data set
        EngineError : a library is missing
        """
        data = Dataset.open(shards)
        manifest, measured = data.manifest, "measured" in data.manifest
        for library in ("mlcroissant", *(["pyarrow"] if config.form == "parquet" else [])):
            if not has_extra(library):
                raise extra_error(library, f"--form {config.form}")
        if config.form == "npz" and manifest["array_format"] != "npz":
            raise UsageError(
                f"{data.folder} holds shards of another format ({manifest['array_format']})",
                where="--form npz",
                hint="use --form parquet",
            )
        if (with_maps or material is not None) and measured:
            raise UsageError(f"{data.folder} holds measured data, without maps", where="--with-maps")
        if material is not None and not with_maps:
            raise UsageError("goes with --with-maps", where="--material")
        for fault in verify(data.folder):
            raise InputError(fault.what, where=data.folder.at(fault.file), hint=fault.hint)
        documents: dict[str, Content] = {}
        if (geometry := manifest["geometry"]) is not None:
            documents[f"data/{GEOMETRY_NAME}"] = data.folder.file(GEOMETRY_NAME, geometry["sha256"])
        if config.form == "npz":
            documents |= {f"data/{name}": content for name, content in public_documents(manifest).items()}
        if not measured:
            documents |= recipe_files(data, with_maps=with_maps, moved=material)
        return cls(data, config, documents, MATERIAL_NAME in documents)

    @cached_property
    def shards(self) -> dict[str, list[Shard]]:
        """Shards of each split that has any."""
        found = {split: self.data.shards(split) for split in self.data.splits}
        return {split: shards for split, shards in found.items() if shards}

    @property
    def name(self) -> str:
        """Name of the published data set: the given one, else that of the material."""
        return self.config.name or name_of(self.data.manifest)

    @property
    def count(self) -> int:
        """Number of shards."""
        return sum(map(len, self.shards.values()))

    @property
    def size(self) -> int:
        """Bytes that the folder takes at most."""
        shards = sum(int(shard.sidecar["bytes"]) for found in self.shards.values() for shard in found)
        contents = self.documents.values()
        documents = sum(c.stat().st_size if isinstance(c, Path) else len(c) for c in contents)
        return round(1.02 * shards) + documents + _DOCUMENT_BYTES

    def _depends(self) -> dict[str, Any]:
        """Plain data that determine the content of the folder."""
        config = self.config
        stored = {s.file: s.sidecar["sha256"] for found in self.shards.values() for s in found}
        return {
            **config.model_dump(mode="json", exclude={"version"}),
            # A long text would make a long message.
            "citation": None if config.citation is None else data_sha256(config.citation),
            "with_maps": self.maps,
            "config_hash": self.data.manifest["config_hash"],
            "shards": data_sha256(stored),
        }

    def _names(self) -> list[str]:
        """Names of all files."""
        shards = [shard for found in self.shards.values() for shard in found]
        data = [f"data/{name}" for shard in shards for name in published_names(shard, self.config.form)]
        return [*self.documents, *data, PICTURE_NAME, CARD_NAME, CROISSANT_NAME]

    def write(
        self, output: Path, *, overwrite: bool = False, progress: Callable[[float], None] = lambda _: None
    ) -> dict[str, Stored]:
        """Write the folder, or finish an unfinished one; returns its files by name. Every shard is read once,
        and `progress` is called with 1 after it.

        Raises
        ------
        InputError : the folder holds something else, or does not fit on the disk
        PartialError : it cannot be written, or another process writes to it; the same command resumes
        """
        check_space(output, self.size, "choose another folder with -o")
        with owned(output):
            folder = OutputFolder.claim(
                output, PUBLICATION, self._depends(), self._names(), overwrite=overwrite
            )
            files = {name: folder.add(name, partial(_store, c)) for name, c in self.documents.items()}
            if self.maps:
                hint = "leave out --with-maps, and add the files of the material to recipe/ by hand"
                check_inputs(self.data, output / MATERIAL, "its copy is read differently", hint)
            stored, samples = self._write_shards(folder, progress)
            files |= stored
            drawn = samples["train"], self.data.lattice.aspect, self.data.geometry()
            files[PICTURE_NAME] = folder.add(PICTURE_NAME, partial(write_picture, *drawn))
            facts = Facts(self.data, self.config, self.name, samples, dict(sorted(files.items())), self.maps)
            for name, text in ((CARD_NAME, card_text(facts)), (CROISSANT_NAME, croissant_text(facts))):
                files[name] = folder.add(name, partial(_store, text.encode()))
            folder.check_added(files)
            return dict(sorted(files.items()))

    def _write_shards(
        self, folder: OutputFolder, progress: Callable[[float], None]
    ) -> tuple[dict[str, Stored], dict[str, Arrays]]:
        """Write the shards: the files, and evenly spaced rows of each split, no two of a group."""
        files, samples = {}, {}
        form, described = self.config.form, self.data.manifest["arrays"]
        for split, shards in self.shards.items():
            lights = self.data.lights_per_path(split)
            step = -(-int(self.data.manifest["splits"][split]["queries"]) // (_SAMPLE * lights))
            parts = []
            for shard in shards:
                arrays = shard.read()
                for name, write in shard_writers(shard, arrays, form, described).items():
                    files[f"data/{name}"] = folder.add(f"data/{name}", write)
                own = slice(None, shard.rows // lights, step)
                parts.append({name: np.array(array[own]) for name, array in arrays.items()})
                progress(1)
            samples[split] = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        return files, samples


def _store(content: Content, path: Path) -> Stored:
    """Write or copy a document, atomically."""
    return copied(content, path) if isinstance(content, Path) else write_chunks(path, [content])
