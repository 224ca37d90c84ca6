"""Imports run downwards between and inside the packages, never in a circle; heavy modules load on use."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import RunPython
from support.paths import ROOT

PACKAGES = ("mbtf_core", "mbtf_gen", "mbtf_fit", "mbtf_pipeline")
HEAVY = {
    "torch",
    "mitsuba",
    "drjit",
    "matplotlib",
    "scipy",
    "trimesh",
    "pyvista",
    "OpenEXR",
    "h5py",
    "dask",
    "distributed",
}
# From the lowest to the highest: a module imports from its own line and from those above it.
ORDER = """
mbtf_core
mbtf_gen.images
mbtf_gen.geometry
mbtf_gen.sampling
mbtf_gen.config
mbtf_gen.fibers
mbtf_gen.meshes
mbtf_gen.measured
mbtf_gen.material
mbtf_gen.render
mbtf_gen.job
mbtf_gen.planning
mbtf_gen.dataset
mbtf_gen.generation mbtf_gen.repairs mbtf_gen.forecast
mbtf_gen.pictures
mbtf_gen.publishing
mbtf_gen.diagnostics
mbtf_gen.cli
mbtf_gen
mbtf_fit.config mbtf_fit.presets mbtf_fit.formatting
mbtf_fit.data
mbtf_fit.native.library mbtf_fit.ops.constants mbtf_fit.textures.lookup
mbtf_fit.surface
mbtf_fit.models
mbtf_fit.objective
mbtf_fit.native
mbtf_fit.material
mbtf_fit.evaluation
mbtf_fit.training
mbtf_fit.viewer
mbtf_fit.shaders
mbtf_fit.backends
mbtf_fit.preview
mbtf_fit.cli
mbtf_fit
mbtf_pipeline.recipe mbtf_pipeline.stages mbtf_pipeline.presets mbtf_pipeline.run_folder mbtf_pipeline.formatting
mbtf_pipeline.compare
mbtf_pipeline.layers
mbtf_pipeline.report
mbtf_pipeline.run
mbtf_pipeline.forecast
mbtf_pipeline.emit
mbtf_pipeline.cost_study
mbtf_pipeline.paper_tables
mbtf_pipeline.library
mbtf_pipeline.cli
mbtf_pipeline
"""  # noqa: E501
RANK = {name: rank for rank, line in enumerate(ORDER.split("\n")) for name in line.split()}
# Top-level names that a package may not import anywhere, not even inside a function.
FORBIDDEN = {
    "mbtf_core": {"torch", "mitsuba", "drjit", "trimesh"},
    "mbtf_gen": {"torch"},
    "mbtf_fit": {"mitsuba", "drjit", "trimesh"},
    "mbtf_pipeline": set(),
}
# The fitter reads data sets, and files that its viewer shows; only its Mitsuba plugin, and the command that
# draws with it, know the renderer.
RENDERING = ("mbtf_fit.backends.mitsuba", "mbtf_fit.preview")
READS = (
    "mbtf_gen.dataset.geometry",
    "mbtf_gen.dataset.reader",
    "mbtf_gen.dataset.shard_io",
    "mbtf_gen.geometry.height_planes",
    "mbtf_gen.images.environment",
    "mbtf_gen.images.resample",
    "mbtf_gen.meshes.shape",
    "mbtf_gen.pictures.camera",
    "mbtf_gen.pictures.reference",
    "mbtf_gen.sampling.rng",
    "mbtf_gen.config.presets",
)


def rank(module: str) -> int:
    """Rank of the room that a module lies in."""
    parts = module.split(".")
    return next(RANK[name] for n in range(len(parts), 0, -1) if (name := ".".join(parts[:n])) in RANK)


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


SOURCES = {module_name(p): p for package in PACKAGES for p in sorted((ROOT / package).rglob("*.py"))}


def imported(source: str) -> Iterator[str]:
    """Names that a source text imports, at any depth; of ours the modules that hold them."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                yield name if name in SOURCES else str(node.module)


def faults(source: str, module: str) -> list[str]:
    """Imports of a source text that break the rules above."""
    package = module.split(".")[0]
    renders = f"{module}.".startswith(tuple(f"{room}." for room in RENDERING))
    forbidden = {"torch", "trimesh"} if renders else FORBIDDEN[package]
    out = []
    for name in imported(source):
        top = name.split(".")[0]
        upwards = top in PACKAGES and rank(name) > rank(module)
        beyond = package == "mbtf_fit" and top == "mbtf_gen" and not renders and not name.startswith(READS)
        if top in forbidden or upwards or beyond:
            out.append(f"{module} imports {name}")
    return out


def test_imports_run_downwards() -> None:
    found = [fault for name, path in SOURCES.items() for fault in faults(path.read_text(), name)]
    assert found == []


@pytest.mark.parametrize(
    ("module", "source", "broken"),
    [
        ("mbtf_gen.render.a", "import torch.nn", True),
        ("mbtf_gen.cli.a", "def f():\n    from mbtf_fit import training", True),
        ("mbtf_gen.render.a", "import mitsuba", False),
        ("mbtf_gen.render.a", "from mbtf_gen.planning.effects import Effect", True),
        (
            "mbtf_gen.config.a",
            "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import mbtf_gen.job",
            True,
        ),
        ("mbtf_gen.planning.a", "from mbtf_gen.render.estimates import Stream", False),
        ("mbtf_core.a", "from mbtf_gen.config import presets", True),
        ("mbtf_fit.data.a", "from mbtf_core.errors import InputError", False),
        ("mbtf_fit.data.a", "from mbtf_gen.geometry import heightfield", True),
        ("mbtf_fit.data.a", "from mbtf_gen.dataset.reader import Dataset", False),
        ("mbtf_fit.a.b", "from mbtf_pipeline.stages import run", True),
        ("mbtf_fit.data.a", "import drjit as dr", True),
        ("mbtf_fit.backends.mitsuba.a", "import drjit as dr", False),
        ("mbtf_fit.backends.mitsuba.a", "import torch", True),
        ("mbtf_pipeline.run", "import mbtf_fit, mbtf_gen, torch", False),
    ],
)
def test_the_check_finds_planted_faults(module: str, source: str, broken: bool) -> None:
    RANK.setdefault("mbtf_fit.a", RANK["mbtf_fit.cli"])
    assert bool(faults(source, module)) is broken


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Groups of modules that import each other, however indirectly (Tarjan 1972)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(name: str) -> None:
        index[name] = low[name] = len(index)
        stack.append(name)
        for other in graph.get(name, ()):
            if other not in index:
                visit(other)
                low[name] = min(low[name], low[other])
            elif other in stack:
                low[name] = min(low[name], index[other])
        if low[name] == index[name]:
            group = stack[stack.index(name) :]
            del stack[stack.index(name) :]
            if len(group) > 1:
                found.append(sorted(group))

    for name in graph:
        if name not in index:
            visit(name)
    return found


def test_no_circle() -> None:
    graph = {name: {i for i in imported(path.read_text()) if i in SOURCES} for name, path in SOURCES.items()}
    assert circles(graph) == []


def test_a_planted_circle_is_found() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": set()}) == [["b", "c"]]


@pytest.mark.parametrize("package", PACKAGES)
def test_importing_a_package_loads_nothing_heavy(package: str, run_python: RunPython) -> None:
    done = run_python("-c", f"import sys, {package}; print(*sorted({HEAVY!r} & set(sys.modules)))")
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []
