"""Imports run one way, heavy modules are loaded on use, lower packages stay free of the upper ones'."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import RunPython

import mbtf_gen

ROOT = Path(mbtf_gen.__file__).resolve().parents[1]
PACKAGES = ("mbtf_gen", "mbtf_fit", "mbtf_pipeline")
HEAVY = {"torch", "mitsuba", "drjit", "matplotlib", "scipy", "trimesh", "pyvista", "OpenEXR"}
# Top-level names that a package may not import anywhere, not even inside a function.
FORBIDDEN = {
    "mbtf_gen": {"mbtf_fit", "mbtf_pipeline", "torch"},
    "mbtf_fit": {"mbtf_pipeline", "mitsuba", "drjit", "trimesh"},
    "mbtf_pipeline": set(),
}
# What the fitter may take from the generator: the vocabulary of queries and shards, and the command line.
VOCABULARY = {
    "mbtf_gen.atomic",
    "mbtf_gen.console",
    "mbtf_gen.dataset",
    "mbtf_gen.directions",
    "mbtf_gen.durations",
    "mbtf_gen.errors",
    "mbtf_gen.levels",
    "mbtf_gen.near",
    "mbtf_gen.quality",
    "mbtf_gen.schema",
    "mbtf_gen.seeds",
    "mbtf_gen.settings",
    "mbtf_gen.shard_files",
    "mbtf_gen.stats",
}
# The fitted material as a renderer's plugin: the one place of the fitter that knows the renderer.
PLUGIN = "mbtf_fit.plugin"


def module_name(path: Path, root: Path = ROOT) -> str:
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(source: str, module: str, *, is_package: bool = False) -> Iterator[str]:
    """Absolute names of the modules that a source text imports, at any depth."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = module.split(".") if is_package else module.split(".")[:-1]
            base = base[: len(base) - (node.level - 1)] if node.level else []
            name = ".".join([*base, *([node.module] if node.module else [])])
            # `from package import module` imports the module too.
            yield from (f"{name}.{alias.name}" for alias in node.names)


def faults(source: str, module: str, *, is_package: bool = False) -> list[str]:
    """Imports of a source text that break the rules above."""
    package = module.split(".")[0]
    plugin = module == PLUGIN or module.startswith(PLUGIN + ".")
    forbidden = {"mbtf_pipeline", "torch", "trimesh"} if plugin else FORBIDDEN[package]
    out = []
    for name in imported(source, module, is_package=is_package):
        parts = name.split(".")
        allowed = (
            package != "mbtf_fit" or parts[0] != "mbtf_gen" or plugin or ".".join(parts[:2]) in VOCABULARY
        )
        if parts[0] in forbidden or not allowed:
            out.append(f"{module} imports {name}")
    return out


def sources() -> list[Path]:
    return sorted(p for package in PACKAGES for p in (ROOT / package).rglob("*.py"))


def test_the_check_sees_every_file() -> None:
    seen = {module_name(p) for p in sources()}
    assert set(PACKAGES) <= seen
    assert "mbtf_gen.errors" in seen


def test_imports_run_one_way() -> None:
    found = [
        fault
        for path in sources()
        for fault in faults(path.read_text(), module_name(path), is_package=path.name == "__init__.py")
    ]
    assert found == []


@pytest.mark.parametrize(
    ("module", "source", "broken"),
    [
        ("mbtf_gen.a", "import torch.nn", True),
        ("mbtf_gen.a", "def f():\n    from mbtf_fit import train", True),
        ("mbtf_gen.a", "import mitsuba", False),
        ("mbtf_fit.a", "from mbtf_gen import errors", False),
        ("mbtf_fit.a", "from mbtf_gen.errors import InputError", False),
        ("mbtf_fit.a", "from mbtf_gen import heightfield", True),
        ("mbtf_fit.a.b", "from mbtf_pipeline.stages import run", True),
        ("mbtf_gen.a.b", "from ..errors import InputError", False),
        ("mbtf_fit.a", "import drjit as dr", True),
        ("mbtf_fit.plugin.a", "import drjit as dr", False),
        ("mbtf_fit.plugin.a", "import torch", True),
        ("mbtf_pipeline.a", "import mbtf_fit, mbtf_gen, torch", False),
    ],
)
def test_the_check_finds_planted_faults(module: str, source: str, broken: bool) -> None:
    assert bool(faults(source, module)) is broken


@pytest.mark.parametrize("package", PACKAGES)
def test_importing_a_package_loads_nothing_heavy(package: str, run_python: RunPython) -> None:
    done = run_python("-c", f"import sys, {package}; print(*sorted({HEAVY!r} & set(sys.modules)))")
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []
