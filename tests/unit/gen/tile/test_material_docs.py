"""``docs/reference/material-yaml.md`` lists every word of file names, and its example is valid."""

from __future__ import annotations

from pathlib import Path

from support.paths import ROOT

from mbtf_gen.tile.loading import load_material
from mbtf_gen.tile.maps.file_names import GLOSS_WORDS, LETTERS, SMOOTHNESS_IN_ALPHA, WEAK_WORDS, WORDS

DOCUMENT = (ROOT / "docs/reference/material-yaml.md").read_text()


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


def test_every_word_is_listed() -> None:
    words = [word for table in (WORDS, WEAK_WORDS) for words in table.values() for word in words]
    for word in (*words, *GLOSS_WORDS, *LETTERS, *SMOOTHNESS_IN_ALPHA):
        assert f"`{word}`" in DOCUMENT.lower(), word
