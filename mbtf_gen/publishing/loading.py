"""The part of a data card that loads the data, for each file format."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mbtf_gen.publishing.escape import fenced
from mbtf_gen.publishing.facts import Facts
from mbtf_gen.publishing.folder import DATA

_PARQUET = """\
import pyarrow.compute as pc
import pyarrow.parquet as pq

table = pq.read_table("{folder}/{first}.parquet")
value_a = pc.list_flatten(table["value_a"], recursive=True).to_numpy().reshape({shape})"""
_TAR = """\
import io, tarfile
import numpy as np

with tarfile.open("{folder}/{first}.tar") as tar:
    blocks = [np.load(io.BytesIO(tar.extractfile(m).read())) for m in tar if m.name.endswith(".value_a.npy")]
value_a = np.concatenate(blocks)  # {shape}"""
_NPZ = """\
import numpy as np

value_a = np.load("{folder}/{first}.npz")["value_a"]  # {shape}"""
_DATASETS = """\
import os
from datasets import load_dataset

# In place of this folder, the name of the data set on the hub will do.
data = load_dataset(os.getcwd(), {configuration}split="{split}").with_format("numpy")
value_a = data[:100]["value_a"]"""
_WEBDATASET = """\
import webdataset

samples = webdataset.WebDataset("{folder}/{first}.tar").decode()
value_a = next(iter(samples))["value_a.npy"]"""


def same_shapes(splits: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> bool:
    """Whether rows of all splits have the same shapes."""
    shapes = [{name: field["shape"] for name, field in fields.items()} for fields in splits.values()]
    return all(shape == shapes[0] for shape in shapes)


def loading_section(facts: Facts, splits: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> str:
    """How to load one array of one split.

    Parameters
    ----------
    facts : Facts
        The data set and what its publishers say.
    splits : mapping
        :meth:`~mbtf_gen.publishing.facts.Facts.fields` of each split.
    """
    if not splits:
        return ""
    form, split = facts.config.form, "test" if "test" in splits else next(iter(splits))
    lengths = ", ".join(str(n) for n in (-1, *splits[split]["value_a"]["shape"]))
    values = {
        "folder": DATA,
        "first": f"{split}-00000",
        "split": split,
        "configuration": "" if same_shapes(splits) else f'"{split}", ',
        "shape": lengths if form == "parquet" else f"shape ({lengths.replace('-1', 'n')})",
    }
    ways = {
        "parquet": ("NumPy and pyarrow", _PARQUET, "`datasets` of Hugging Face", _DATASETS),
        "webdataset": ("NumPy", _TAR, "WebDataset", _WEBDATASET),
        "npz": ("NumPy", _NPZ, "", ""),
    }[form]
    parts = ["## Load", f"With {ways[0]}, in this folder:", fenced(ways[1].format(**values), "python")]
    if ways[2]:
        parts += [f"With {ways[2]}:", fenced(ways[3].format(**values), "python")]
    if form == "npz":
        parts.append(f"The folder `{DATA}` is a complete data set of mbtf: `mbtf-fit {DATA}/` trains on it.")
    return "\n\n".join(parts)
