"""``docs/materials.md`` lists every key of a material file and every word of file names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from support.paths import ROOT

from mbtf_core.config_file import Settings
from mbtf_gen.images.read import MAX_PIXELS, SUFFIXES
from mbtf_gen.material.discovery import UNUSED, WORDS, role_of
from mbtf_gen.material.inspect import ALBEDO_RANGE
from mbtf_gen.material.material import FLOAT_SCALE, INTEGER_SCALE, load_material
from mbtf_gen.material.spec import ColorEntry, HeightEntry, MaterialFile, NormalEntry, ShareEntry
from mbtf_gen.material.tiling import BAND

DOCUMENT = (ROOT / "docs/materials.md").read_text()
ENTRIES: dict[str, type[Settings]] = {
    "material.yaml": MaterialFile,
    "height": HeightEntry,
    "base_color": ColorEntry,
    "roughness, metallic, specular, opacity": ShareEntry,
    "normal": NormalEntry,
}


def default_of(field: Any) -> str:
    """A field's default as the document shows it; a dash where its description says it or there is none."""
    if field.is_required() or field.default is None:
        return "–"
    return f"`{str(field.default).lower() if isinstance(field.default, bool) else field.default}`"


def key_table(model: type[Settings]) -> str:
    """Markdown table of a model's keys."""
    rows = [
        f"| `{name}` | {default_of(field)} | {field.description} |"
        for name, field in model.model_fields.items()
    ]
    return "\n".join(["| key | default | meaning |", "|---|---|---|", *rows])


def word_table() -> str:
    """Markdown table of the words that name maps."""
    rows = [f"| {role} | {', '.join(f'`{w}`' for w in words)} |" for role, words in WORDS.items()]
    reasons = dict.fromkeys(UNUSED.values())
    for why in reasons:
        words = ", ".join(f"`{w}`" for w, reason in UNUSED.items() if reason == why)
        rows.append(f"| not used: {why} | {words} |")
    return "\n".join(["| map | words |", "|---|---|", *rows])


@pytest.mark.parametrize("title", ENTRIES)
def test_every_key_is_documented(title: str) -> None:
    for field in ENTRIES[title].model_fields.values():
        assert field.description
    table = key_table(ENTRIES[title])
    assert table in DOCUMENT, f"docs/materials.md lacks this table of '{title}':\n{table}"


def test_every_word_is_documented() -> None:
    assert word_table() in DOCUMENT, f"docs/materials.md lacks this table:\n{word_table()}"
    for role, words in WORDS.items():
        assert [role_of(f"rock_{word}.png") for word in words] == [role] * len(words)


def test_numbers_are_those_of_the_code() -> None:
    for text in (
        f"{MAX_PIXELS:,} pixels",
        f"{INTEGER_SCALE:g} tile widths",
        f"factor {FLOAT_SCALE:g}",
        f"{BAND:g} of the tile",
        f"{ALBEDO_RANGE[0]:g} to {ALBEDO_RANGE[1]:g}",
        ", ".join(f"`{s}`" for s in SUFFIXES),
    ):
        assert text in DOCUMENT, text


def test_the_content_of_inspect_is_documented(tmp_path: Path) -> None:
    import numpy as np

    from mbtf_gen.material.inspect import inspect_material

    np.save(tmp_path / "h.npy", np.zeros((4, 4)))
    rows = DOCUMENT.split("| key | content |", 1)[1].split("\n\n", 1)[0].splitlines()
    keys = {word.strip(" `") for row in rows[2:] for word in row.split("|")[1].split(",")}
    assert keys == {"material", *inspect_material(load_material(tmp_path / "h.npy"))}


def test_the_example_is_valid(tmp_path: Path) -> None:
    """The document's material file, with maps of those names beside it."""
    import numpy as np
    from support.image_files import exr, png, rng

    text = DOCUMENT.split("```yaml\n", 1)[1].split("```", 1)[0]
    (tmp_path / "material.yaml").write_text(text)
    png(tmp_path / "cliff_diff.png", rng().integers(0, 200, (8, 8, 3)), 2, 8)
    png(tmp_path / "cliff_arm.png", rng().integers(0, 200, (8, 8, 3)), 2, 8)
    png(tmp_path / "cliff_nor.png", np.full((8, 8, 3), (128, 128, 255)), 2, 8)
    layers = {n: rng().random((8, 8)).astype(np.float32) for n in ("R", "G", "B", "displacement.Y")}
    exr(tmp_path / "cliff.exr", layers)
    material = load_material(tmp_path)
    assert np.array_equal(material.height, layers["displacement.Y"])
    assert material.height_scale == 0.12
