"""Packages of extras: where one is missing, one error names the extra that installs it."""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support.paths import ROOT

from mbtf_core.data.store import open_store
from mbtf_core.errors import EngineError
from mbtf_core.extras import EXTRAS, import_extra
from mbtf_core.run.cluster import open_runner
from mbtf_fit.backends.shader.slang import SlangCompiler
from mbtf_fit.export import gltf, materialx, usd
from mbtf_gen.measured.hdf5 import hdf5_file
from mbtf_gen.publishing.croissant import croissant_text
from mbtf_gen.publishing.formats import write_parquet
from mbtf_pipeline.compare import perceptual_metrics

EXPORT: Any = SimpleNamespace(shared={})


def export(target: Any) -> Callable[[Path], object]:
    return lambda folder: target.TARGET.write(EXPORT, None)


def workers(where: str) -> Callable[[Path], object]:
    """Opens workers of an engine that a file names."""

    def use(folder: Path) -> None:
        file = folder / "cluster.yaml"
        file.write_text(f"engine: {where}\nmemory: 1GB\n")
        with open_runner(str(file), lambda line: None):
            pass

    return use


# What needs a module, called with a folder.
USES: list[tuple[str, Callable[[Path], object]]] = [
    ("MaterialX", export(materialx)),
    ("dask", workers("local")),
    ("dask_jobqueue", workers("slurm")),
    ("distributed", workers("local")),
    ("fsspec", lambda folder: open_store("s3://bucket/data")),
    ("h5py", lambda folder: hdf5_file(folder / "data.h5").__enter__()),
    ("mlcroissant", lambda folder: croissant_text(EXPORT)),
    ("pxr", export(usd)),
    ("pyarrow", lambda folder: write_parquet(folder / "a.parquet", {}, {})),
    ("pygltflib", export(gltf)),
    ("s3fs", lambda folder: open_store("s3://bucket/data")),
    ("slangpy", lambda folder: SlangCompiler()),
    ("stlpips_pytorch", lambda folder: perceptual_metrics.require()),
]


@pytest.mark.parametrize(("module", "use"), USES, ids=[f"{n}-{name}" for n, (name, _) in enumerate(USES)])
def test_one_error_names_the_extra(
    module: str, use: Callable[[Path], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.startswith(f"{module}.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(EngineError, match="is not installed") as raised:
        use(tmp_path)
    extra, distribution = EXTRAS[module]
    assert raised.value.hint == f"pip install 'mbtf[{extra}]'"
    assert raised.value.what.startswith(distribution)
    assert raised.value.where


def test_every_module_has_a_use() -> None:
    assert {module for module, _ in USES} == set(EXTRAS)


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
