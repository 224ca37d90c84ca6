"""Scripts of `benchmarks/` as modules."""

from __future__ import annotations

import importlib.util
import sys
from typing import Any

from support.paths import ROOT

BENCHMARKS = ROOT / "benchmarks"


def benchmark_module(name: str) -> Any:
    """The script of a name, loaded under one that no package has."""
    spec = importlib.util.spec_from_file_location(f"benchmarks_{name}", BENCHMARKS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
