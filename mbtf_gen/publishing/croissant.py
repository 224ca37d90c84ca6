"""``croissant.json``: the data set in the vocabulary of Croissant 1.1 (MLCommons), as JSON-LD.

Every file is a FileObject with its size and SHA-256. The records of Parquet files are described column by
column; Croissant has no reader of ``.npy``, so that other forms have files only.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Any

from mbtf_core.files.atomic import Stored
from mbtf_gen.publishing.facts import TAGS, Facts
from mbtf_gen.publishing.folder import DATA

CROISSANT_NAME = "croissant.json"
_CONFORMS_TO = "http://mlcommons.org/croissant/1.1"
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "arrayShape": "cr:arrayShape",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "containedIn": "cr:containedIn",
    "cr": "http://mlcommons.org/croissant/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "description": {"@container": "@language"},
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileObject": "cr:fileObject",
    "fileProperty": "cr:fileProperty",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isArray": "cr:isArray",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "name": {"@container": "@language"},
    "parentField": "cr:parentField",
    "path": "cr:path",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}
_FORMATS = {
    ".parquet": "application/x-parquet",
    ".tar": "application/x-tar",
    ".npz": "application/zip",
    ".exr": "image/x-exr",
    ".png": "image/png",
    ".json": "application/json",
    ".yaml": "application/yaml",
    ".sh": "application/x-sh",
}


def license_address(expression: str) -> str:
    """Address of a license of the SPDX list; other expressions as they are."""
    listed = re.fullmatch(r"(?!LicenseRef-)[A-Za-z0-9.+-]+", expression)
    return f"https://spdx.org/licenses/{expression}.html" if listed else expression


def croissant_text(
    facts: Facts, files: Mapping[str, Stored], splits: Mapping[str, Mapping[str, Mapping[str, Any]]]
) -> str:
    """The document.

    Parameters
    ----------
    facts : Facts
        The data set and what its publishers say.
    files : mapping of str to Stored
        The published files that it lists, by name.
    splits : mapping
        :meth:`~mbtf_gen.publishing.facts.Facts.fields` of each split.

    Returns
    -------
    str
    """
    config = facts.config
    document: dict[str, Any] = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": _CONFORMS_TO,
        "name": facts.slug,
        "alternateName": facts.name,
        "description": facts.summary,
        "license": license_address(config.license),
        "keywords": list(TAGS),
    }
    optional = {"url": config.url, "citeAs": config.citation, "datePublished": config.date}
    document |= {key: value for key, value in optional.items() if value is not None}
    if config.author:
        document["creator"] = [{"@type": "sc:Person", "name": name} for name in config.author]
    document["distribution"] = [_file(name, stored) for name, stored in files.items()]
    if config.form == "parquet":
        document["distribution"] += [_file_set(split) for split in splits]
        document["recordSet"] = [_records(facts, split, fields) for split, fields in splits.items()]
    text = json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False)
    # Pages embed the document in a script element, which these characters could end.
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text + "\n"


def _file(name: str, stored: Stored) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": name,
        "name": name,
        "contentUrl": name,
        "contentSize": f"{stored.bytes} B",
        "encodingFormat": _FORMATS.get(PurePosixPath(name).suffix.lower(), "application/octet-stream"),
        "sha256": stored.sha256,
    }


def _file_set(split: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileSet",
        "@id": f"{split}-files",
        "name": f"{split}-files",
        "encodingFormat": _FORMATS[".parquet"],
        "includes": f"{DATA}/{split}-*.parquet",
    }


def _records(facts: Facts, split: str, fields: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    return {
        "@type": "cr:RecordSet",
        "@id": split,
        "name": split,
        "description": f"Split {split}. A record is {facts.layout}.",
        "field": [_field(split, name, field) for name, field in fields.items()],
    }


def _field(split: str, name: str, field: Mapping[str, Any]) -> dict[str, Any]:
    out: dict[str, Any] = {
        "@type": "cr:Field",
        "@id": f"{split}/{name}",
        "name": name,
        "description": f"{field['meaning']} [{field['unit']}]",
        "dataType": "cr:Float32",
        "source": {"fileSet": {"@id": f"{split}-files"}, "extract": {"column": name}},
    }
    if field["shape"]:
        out |= {"isArray": True, "arrayShape": ",".join(str(n) for n in field["shape"])}
    return out
