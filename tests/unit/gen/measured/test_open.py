"""Each kind of file finds its reader by its content, whatever its name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support import measured_files as files

from mbtf_core.errors import InputError
from mbtf_gen.measured.hdf5 import NeumipQueries, NeuralBtf
from mbtf_gen.measured.open import open_measured
from mbtf_gen.measured.ubo2003 import Ubo2003
from mbtf_gen.measured.ubo2014 import Ubo2014


def test_each_kind(tmp_path: Path) -> None:
    path = tmp_path / "data"
    path.write_bytes(files.btf())
    assert isinstance(open_measured(path), Ubo2014)
    path.write_bytes(files.zipped(files.photographs()))
    assert isinstance(open_measured(path), Ubo2003)
    assert isinstance(open_measured(files.write_folder(tmp_path / "a", files.photographs())), Ubo2003)
    capture = {
        "ground_light": np.zeros((1, 2)),
        "ground_camera_dir": np.zeros((1, 2)),
        "ground_color": np.zeros((1, 2, 2, 3)),
    }
    assert isinstance(open_measured(files.write_hdf5(path, capture)), NeuralBtf)
    queries = {name: np.zeros((1, 2, 2, 2)) for name in ("ground_light", "ground_camera_dir")}
    queries["ground_camera_target_loc"] = np.zeros((1, 2, 2, 2))
    queries["ground_camera_query_radius"] = np.zeros((1, 2, 2, 1))
    queries["ground_color"] = np.zeros((1, 2, 2, 3))
    assert isinstance(open_measured(files.write_hdf5(path, queries)), NeumipQueries)


def test_unknown(tmp_path: Path) -> None:
    for content, message in (
        (b"", "known kind"),
        (b"hello", "known kind"),
        (b"!ABC", "DFMF08FCR"),
        (b"PK", "zip"),
    ):
        (tmp_path / "a").write_bytes(content)
        with pytest.raises(InputError) as caught:
            open_measured(tmp_path / "a")
        assert message in caught.value.message
    with pytest.raises(InputError, match="without 'ground_color'"):
        open_measured(files.write_hdf5(tmp_path / "a", {"other": np.zeros(3)}))
    with pytest.raises(InputError, match="no such file"):
        open_measured(tmp_path / "none")
