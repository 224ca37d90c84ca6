"""Folders of reference pictures that others read."""

from __future__ import annotations

from pathlib import Path

import pytest

from mbtf_core.errors import InputError
from mbtf_core.pictures import claim_pictures, read_references


def test_folders_without_pictures_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no pictures of mbtf-gen reference"):
        read_references(tmp_path)
    options = {"view": {"elevation": 40, "azimuth": 0}, "light": {}, "tiles_across": [2]}
    config = {"reference": options}
    claim_pictures(tmp_path, "mbtf-gen reference", files=[], config=config, inputs={})
    with pytest.raises(InputError, match="no finished picture"):
        read_references(tmp_path)
