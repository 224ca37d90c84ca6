"""Folders of reference pictures that others read."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mbtf_core.errors import InputError
from mbtf_core.pictures.reference import read_references


def test_folders_without_pictures_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no pictures of mbtf-gen reference"):
        read_references(tmp_path)
    for record in ({"kind": "preview"}, {"kind": "reference"}):
        (tmp_path / "pictures.json").write_text(json.dumps(record))
        with pytest.raises(InputError, match="no pictures of mbtf-gen reference"):
            read_references(tmp_path)
    options = {"view": {"elevation": 40, "azimuth": 0}, "light": {}, "tiles_across": [2]}
    record = {"kind": "reference", "depends": {"reference": options}, "pictures": {}}
    (tmp_path / "pictures.json").write_text(json.dumps(record))
    with pytest.raises(InputError, match="no finished picture"):
        read_references(tmp_path)
