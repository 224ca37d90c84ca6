"""Damaged fitted materials and checkpoints: they load, or are refused in a line or two."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import load, save
from support.fit_data import constant, write_data
from support.fuzzing import altered, damaged, loads_or_refuses

from mbtf_core.errors import InputError
from mbtf_core.files.atomic import file_sha256
from mbtf_fit import FitConfig, Material, fit, read_history

CONFIG = FitConfig.model_validate(
    {"training": {"steps": 2, "batch": 50, "warmup": 1}, "network": {"channels": 2, "width": 4, "layers": 2}}
)
DESCRIPTION, WEIGHTS = "material.json", "weights.safetensors"


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data(tmp_path_factory.mktemp("data"), constant(0.2), train=200, test=50, shards=1, finest=2)


@pytest.fixture(scope="module")
def whole(shards: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished material."""
    return fit(CONFIG, shards, tmp_path_factory.mktemp("fit") / "material").folder


@pytest.fixture(scope="module")
def folder(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy to be damaged."""
    return Path(shutil.copytree(whole, tmp_path_factory.mktemp("copy") / "material"))


def use(folder: Path) -> None:
    """Load a material and evaluate it."""
    Material.load(folder).deviation()
    read_history(folder)


def write(folder: Path, whole: Path, description: str | None, weights: bytes | None) -> None:
    """Put files into the copy; the description names the digest of the weights that are there."""
    before = (whole / WEIGHTS).read_bytes()
    (folder / WEIGHTS).write_bytes(before if weights is None else weights)
    text = description if description is not None else (whole / DESCRIPTION).read_text()
    (folder / DESCRIPTION).write_text(
        text.replace(file_sha256(whole / WEIGHTS), file_sha256(folder / WEIGHTS))
    )


@given(data=st.data())
@settings(max_examples=40)
def test_an_altered_description(data: st.DataObject, whole: Path, folder: Path) -> None:
    write(folder, whole, data.draw(altered(described(whole))), None)
    loads_or_refuses(lambda: use(folder))


def described(whole: Path) -> str:
    """The description without what differs from run to run."""
    found = json.loads((whole / DESCRIPTION).read_text())
    del found["conventions"]
    return json.dumps(found)


@given(data=st.data())
@settings(max_examples=40)
def test_damaged_weights(data: st.DataObject, whole: Path, folder: Path) -> None:
    _, content = data.draw(damaged({WEIGHTS: (whole / WEIGHTS).read_bytes()}))
    write(folder, whole, None, content)
    loads_or_refuses(lambda: use(folder))


def odd_tensors(whole: Path) -> dict[str, tuple[dict[str, torch.Tensor], str]]:
    """Invalid contents of the weights and their messages."""
    good = load((whole / WEIGHTS).read_bytes())
    name = next(n for n in good if n.endswith("weight"))
    no_fit = "do not fit the model"
    return {
        "none": ({}, "lacks the tensor 'conformance.u'"),
        "no weights": ({n: t for n, t in good.items() if n.startswith("conformance")}, no_fit),
        "one too many": ({**good, "extra": torch.zeros(1)}, no_fit),
        "another shape": ({**good, name: torch.zeros(1)}, no_fit),
        "few queries": ({**good, "conformance.u": torch.zeros(3, 2)}, "has the shape (3, 2)"),
        "flat queries": ({**good, "conformance.rgb": torch.zeros(256)}, "has the shape (256,)"),
        "integers": ({**good, name: good[name].view(torch.int32)}, "another type"),
        "bfloat16": ({**good, name: good[name].bfloat16()}, "another type"),
        "NaN": ({**good, name: good[name] * math.nan}, "not finite"),
        "infinite": ({**good, name: good[name] / 0.0}, "not finite"),
        "many": ({**good, **{f"t{k}": torch.zeros(0) for k in range(10_000)}}, "more than 10,000 tensors"),
    }


def test_odd_tensors(whole: Path, folder: Path) -> None:
    for case, (tensors, message) in odd_tensors(whole).items():
        padding = {} if tensors else {"padding": torch.zeros(1000)}
        write(folder, whole, None, save({**tensors, **padding}))
        with pytest.raises(InputError) as caught:
            Material.load(folder)
        assert message in caught.value.what, case


@pytest.mark.parametrize(
    ("lookup", "levels", "aspect"),
    [({}, 13, 1.0), ({}, 2, 1e6), ({"channels": 1000}, 8, 1.0), ({"channels": 2**62}, 13, 1e6)],
)
def test_descriptions_larger_than_the_weights(
    lookup: dict[str, int], levels: int, aspect: float, whole: Path, folder: Path
) -> None:
    description = json.loads((whole / DESCRIPTION).read_text())
    for operation in description["operations"]:
        if operation["operation"] == "lookup":
            operation.update(lookup)
    description["levels"]["finest"], description["tile"]["aspect"] = levels, aspect
    write(folder, whole, json.dumps(description), None)
    with pytest.raises(InputError, match=r"is too small for the operations and levels|overflow"):
        Material.load(folder)


def test_odd_operations(whole: Path, folder: Path) -> None:
    description = json.loads((whole / DESCRIPTION).read_text())
    good = description["operations"]
    square = {"operation": "transform", "x": "u", "function": "square"}
    for operations, message in (
        ([*good, good[-1]], "is computed twice"),
        ([{**square, "output": "level"}, *good], "is computed twice"),
        ([{**square, "output": "a", "x": "b"}, {**square, "output": "b", "x": "a"}, *good], "'b'"),
        ([*({**square, "output": f"x{k}"} for k in range(1000)), *good], "more than 1000 operations"),
    ):
        write(folder, whole, json.dumps({**description, "operations": operations}), None)
        with pytest.raises(InputError, match=message):
            Material.load(folder)


@pytest.mark.parametrize(
    "content", [b"", b"garbage", save({"a": torch.zeros(1)}), save({"a": torch.zeros(1)}, {"mbtf": "[1]"})]
)
def test_a_checkpoint_of_something_else(content: bytes, shards: Path, tmp_path: Path, whole: Path) -> None:
    out = tmp_path / "fit"
    fit(CONFIG, shards, out)
    for name in (DESCRIPTION, WEIGHTS):
        (out / name).unlink()
    (out / "checkpoint.safetensors").write_bytes(content)
    with pytest.raises(InputError, match="is not a checkpoint of this fit") as caught:
        fit(CONFIG, shards, out)
    # The hint cures.
    (out / "checkpoint.safetensors").unlink()
    assert "remove it" in caught.value.hint
    assert fit(CONFIG, shards, out).folder == out
