"""``croissant.json``: the data set in the vocabulary of Croissant 1.1 (MLCommons), written by mlcroissant.

Every file is a FileObject with its size and SHA-256. The records of Parquet files are described column by
column; Croissant has no reader of ``.npy``, so that other forms have files only.
"""

from __future__ import annotations

import json
import re
from pathlib import PurePosixPath
from typing import Any

from mbtf_core.extras import import_extra
from mbtf_gen.publishing.facts import TAGS, Facts

CROISSANT_NAME = "croissant.json"
_FORMATS = {
    ".parquet": "application/x-parquet",
    ".npz": "application/zip",
    ".exr": "image/x-exr",
    ".png": "image/png",
    ".json": "application/json",
    ".yaml": "application/yaml",
}


def croissant_text(facts: Facts) -> str:
    """The document, which lists the files of the facts."""
    mlc = import_extra("mlcroissant", "croissant.json")
    config, license = facts.config, facts.config.license
    listed = re.fullmatch(r"(?!LicenseRef-)[A-Za-z0-9.+-]+", license)
    distribution: list[Any] = [
        mlc.FileObject(
            id=name,
            name=name,
            content_url=name,
            content_size=f"{stored.bytes} B",
            encoding_formats=[_FORMATS.get(PurePosixPath(name).suffix.lower(), "application/octet-stream")],
            sha256=stored.sha256,
        )
        for name, stored in facts.files.items()
    ]
    splits = facts.shapes if config.form == "parquet" else {}
    distribution += [
        mlc.FileSet(
            id=f"{split}-files",
            name=f"{split}-files",
            encoding_formats=[_FORMATS[".parquet"]],
            includes=[f"data/{split}-*.parquet"],
        )
        for split in splits
    ]
    metadata = mlc.Metadata(
        ctx=mlc.Context(conforms_to="http://mlcommons.org/croissant/1.1"),
        name=re.sub(r"[^A-Za-z0-9]+", "-", facts.name).strip("-").lower()[:200] or "material",
        description=facts.summary,
        license=[f"https://spdx.org/licenses/{license}.html" if listed else license],
        keywords=list(TAGS),
        url=config.url,
        cite_as=config.citation,
        date_published=config.date,
        creators=[mlc.Person(name=name) for name in config.author],
        distribution=distribution,
        record_sets=[_records(facts, split) for split in splits],
    )
    document = metadata.to_json() | {"alternateName": facts.name}
    text = json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False, default=str)
    # Pages embed the document in a script element, which these characters could end.
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text + "\n"


def _records(facts: Facts, split: str) -> Any:
    mlc = import_extra("mlcroissant", "croissant.json")
    described = facts.data.manifest["arrays"]
    fields = []
    for name, shape in facts.shapes[split].items():
        array = {"is_array": True, "array_shape": ",".join(str(n) for n in shape)} if shape else {}
        fields.append(
            mlc.Field(
                id=f"{split}/{name}",
                name=name,
                description=f"{described[name]['meaning']} [{described[name]['unit']}]",
                data_types=mlc.DataType.FLOAT32,
                source=mlc.Source(file_set=f"{split}-files", extract=mlc.Extract(column=name)),
                **array,
            )
        )
    text = f"Split {split}. A record is {facts.row}."
    return mlc.RecordSet(id=split, name=split, description=text, fields=fields)
