"""The reader of materials in ``examples/``, as a module."""

from __future__ import annotations

import importlib.util
from types import ModuleType

from .paths import ROOT


def _load() -> ModuleType:
    spec = importlib.util.spec_from_file_location("read_material", ROOT / "examples" / "read_material.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


read_material = _load()
