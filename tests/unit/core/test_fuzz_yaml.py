"""Damaged, hostile and odd YAML: it is taken, or refused in a line or two; no other exception, no hang."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.fuzzing import damaged, loads_or_refuses

from mbtf_core.config.settings import resolve
from mbtf_core.config.yaml_file import read_yaml
from mbtf_core.errors import InputError
from mbtf_fit.config import FitConfig
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.tile.loading import load_material
from mbtf_pipeline.recipe import load_recipe

MATERIAL = """\
height: {file: heights.npy, scale: 0.1}
base_color: [0.5, 0.4, 0.3]
roughness: 0.4
metallic: heights.npy
normal: {file: normal.npy, convention: gl}
"""
BSDF = "height: heights.npy\nbsdf: {type: principled, roughness: {type: bitmap, filename: normal.npy}}\n"
CONFIG = """\
material: heights.npy
geometry: {height_scale: 0.1, mesh: 64}
queries:
  train: 400/texel
  mixture: {log_uniform: 1, finest: 0}
seed: 7
"""
FIT = """\
model: neumip
training: {time: 2min, batch: 1024, blur: {initial_sigma: 4}}
held_out: {queries: 0.1, direction: [0.1, 0.2]}
"""
RECIPE = """\
version: 3
name: small
generate:
  material: heights.npy
  queries: {train: 100, test: 100}
fit:
  a: {model: neumip, training: {steps: 5}}
  b: {model: neumip-baseline}
compare:
  views: [{elevation: 60, azimuth: 0}, {elevation: 90}]
  tiles_across: [1, 4]
  kinds: [query]
report: {title: "Small: a test"}
"""
DOCUMENTS: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "material": (MATERIAL, load_material),
    "bsdf": (BSDF, load_material),
    "config": (CONFIG, lambda path: resolve(GeneratorConfig, file=path)),
    "fit": (FIT, lambda path: resolve(FitConfig, file=path)),
    "recipe": (RECIPE, load_recipe),
}
# What YAML readers and validators stumble over.
ODD = [
    *("~", "null", "yes", "true", ".nan", "-.inf", "-0.0", "0x1f", "0o17", "1e400", "1_000"),
    *("9" * 40, "9" * 5000, "2001-01-01", "2001-99-99", "12:30:45", "0b_", "._", "1e5", "-1", "0", "1.5"),
    *("[]", "{}", "[[[]]]", "[1, [2]]", "{a: {b: c}}", "!!python/name:os.system", "!!binary AAAA", "!x y"),
    *("!!int x", "!!bool x", "!!omap x", "!!set {a, b}", "!!str", "&a [*a]", "*nowhere", "<<: *x", "'", '"'),
    *("\t", "- ", ": ", "? ", "#", "%YAML 1.1", "---", "...", "|", ">", "\x00", "\x07", "\ufeff", "\ud7ff"),
    *("\u2028", "a\u0301", "🙂", "\\", "../../etc/passwd", "/dev/null", "a\\0b", '"a\\0b"', "x" * 300, "."),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the maps that the documents name."""
    made = tmp_path_factory.mktemp("yaml")
    np.save(made / "heights.npy", np.random.default_rng(0).random((4, 4)))
    np.save(made / "normal.npy", np.random.default_rng(0).random((4, 4, 3)))
    return made


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str], Path]:
    def write(text: str) -> Path:
        path = tmp_path / "a.yaml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


@st.composite
def odd(draw: st.DrawFn, text: str) -> str:
    """The text with some of its words or lines exchanged for odd ones, repeated, or shifted."""
    lines = text.splitlines()
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, len(lines) - 1))
        line, what = lines[at], draw(st.sampled_from(["value", "key", "insert", "double", "indent", "add"]))
        thing = draw(st.sampled_from(ODD))
        if what == "value":
            lines[at] = f"{line.partition(':')[0]}: {thing}"
        elif what == "key":
            lines[at] = f"{thing}:{line.partition(':')[2]}"
        elif what == "insert":
            place = draw(st.integers(0, len(line)))
            lines[at] = line[:place] + thing + line[place:]
        elif what == "double":
            lines.insert(at, line)
        elif what == "indent":
            lines[at] = draw(st.sampled_from([" ", "  ", "\t", "      "])) + line
        else:
            lines.insert(at, thing)
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("kind", DOCUMENTS)
@given(data=st.data())
@settings(max_examples=120)
def test_odd_words(kind: str, data: st.DataObject, folder: Path) -> None:
    text, load = DOCUMENTS[kind]
    path = folder / f"{kind}.yaml"
    path.write_text(data.draw(odd(text)))
    loads_or_refuses(lambda: load(path))


@given(data=st.data())
@settings(max_examples=120)
def test_damaged_bytes(data: st.DataObject, folder: Path) -> None:
    kind, content = data.draw(damaged({k: text.encode() for k, (text, _) in DOCUMENTS.items()}))
    path = folder / f"{kind}.yaml"
    path.write_bytes(content)
    loads_or_refuses(lambda: DOCUMENTS[kind][1](path))


BOMB = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 10)}]\n"
    for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)
HOSTILE = {
    "a bomb of aliases": (BOMB, "holds more than 100,000 values"),
    "indentation": ("\n".join(" " * i + "a:" for i in range(400)), "nested more than 100 levels deep"),
    "a flood": ("a: 1\n" * 100_000, "is too long"),
    "merges": (
        f"a: &a {{{', '.join(f'k{k}: 1' for k in range(1000))}}}\n"
        + "".join(f"b{k}:\n  <<: *a\n" for k in range(200)),
        "too many keys",
    ),
    "a long number": ("a: " + "9" * 5000, "not valid YAML"),
    "a foreign object": ("a: !!python/object/apply:os.system ['true']", "holds the tag"),
    "a list as key": ("? [a, b]\n: 1", "is not text"),
    "a key twice": ("a: 1\na: 2\n", "duplicate key"),
    "two documents": ("a: 1\n---\nb: 2\n", "another document"),
    "a list": ("- a\n", "must hold a mapping"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_yaml(case: str, write: Callable[[str], Path]) -> None:
    text, message = HOSTILE[case]
    with pytest.raises(InputError) as caught:
        read_yaml(write(text))
    assert message in caught.value.what


@pytest.mark.parametrize("text", ["a: &a [*a]\n", "a: &a\n  b: *a\n", "&a a: {b: *a}\n"])
def test_a_value_that_holds_itself(text: str, write: Callable[[str], Path]) -> None:
    path = write(text)
    loads_or_refuses(lambda: resolve(GeneratorConfig, file=path))
    loads_or_refuses(lambda: load_material(path))


@pytest.mark.parametrize("text", ["a: " + "[" * 100_000, "a: " + "{a: " * 5_000])
def test_brackets_are_counted_first(
    text: str, write: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    # The reader's time grows with the square of their depth.
    monkeypatch.setattr("mbtf_core.config.yaml_file._yaml", lambda: pytest.fail("the text was read"))
    with pytest.raises(InputError, match="levels deep"):
        read_yaml(write(text))
