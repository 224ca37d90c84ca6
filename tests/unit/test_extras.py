"""Packages of extras: where one is missing, one error names the extra that installs it."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

import pytest
from support.paths import ROOT

from mbtf_core.errors import EngineError
from mbtf_core.extras import EXTRAS, import_extra
from mbtf_gen.measured.hdf5 import hdf5_file


def test_one_error_names_the_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """test_imports.py makes sure that modules of extras are imported in this way alone."""
    for module, (extra, distribution) in EXTRAS.items():
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(EngineError) as raised:
            import_extra(module, "a.file")
        assert (
            raised.value.message == f"a.file: {distribution} is not installed\n  pip install 'mbtf[{extra}]'"
        )
    with pytest.raises(EngineError, match="h5py is not installed"), hdf5_file(tmp_path / "data.h5"):
        pass


def test_a_package_that_cannot_be_imported_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mlcroissant.py").write_text("import no_such_dependency\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "mlcroissant", raising=False)
    with pytest.raises(EngineError, match=r"cannot be imported.*no_such_dependency"):
        import_extra("mlcroissant", "croissant.json")


def test_the_extras_of_the_table_install_their_packages() -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    found = {
        (extra, re.split(r"[^\w-]", requirement)[0])
        for extra, requirements in declared.items()
        if extra != "dev"
        for requirement in requirements
    }
    # The dashboard of Dask, which imports it.
    assert found - set(EXTRAS.values()) == {("cluster", "bokeh")}
    assert set(EXTRAS.values()) <= found
