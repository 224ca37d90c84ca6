"""Imports run downwards between and inside the packages, never in a circle; heavy modules load on use."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from graphlib import TopologicalSorter
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from conftest import RunPython
from support.paths import ROOT

PACKAGES = ("mbtf_core", "mbtf_gen", "mbtf_fit", "mbtf_pipeline")
# The rooms from the lowest to the highest: folders, or single files, of the packages. A room imports from its
# own line and from those above it. A package's name stands for its files that no line names.
ROOMS = """
mbtf_core
mbtf_core.config
mbtf_core.files
mbtf_core.run
mbtf_core.app
mbtf_core.images
mbtf_core.meshes
mbtf_core.data
mbtf_core.stats
mbtf_core.pictures
mbtf_core.forecast
mbtf_gen.sampling
mbtf_gen.measured
mbtf_gen.engine
mbtf_gen.config
mbtf_gen.tile.tracers
mbtf_gen.tile.heights
mbtf_gen.tile.fibers
mbtf_gen.tile.maps
mbtf_gen.tile
mbtf_gen.render
mbtf_gen.checks
mbtf_gen.doctor mbtf_gen.selftest
mbtf_gen.job
mbtf_gen.planning
mbtf_gen.forecast
mbtf_gen.generation
mbtf_gen.pictures
mbtf_gen.publishing
mbtf_gen.cli
mbtf_gen
mbtf_fit.sections
mbtf_fit.formatting
mbtf_fit.ops
mbtf_fit.data
mbtf_fit.native
mbtf_fit.surface
mbtf_fit.pytorch
mbtf_fit.objective
mbtf_fit.backends.cpu
mbtf_fit.models
mbtf_fit.config
mbtf_fit.material
mbtf_fit.evaluation
mbtf_fit.training
mbtf_fit.backends.mitsuba
mbtf_fit.backends.shader
mbtf_fit.preview
mbtf_fit.comparison
mbtf_fit.viewer
mbtf_fit.export
mbtf_fit.cli
mbtf_fit
mbtf_pipeline.recipe
mbtf_pipeline.stages
mbtf_pipeline.compare
mbtf_pipeline.stages
mbtf_pipeline.tables
mbtf_pipeline.report
mbtf_pipeline.run
mbtf_pipeline.collection
mbtf_pipeline.run_time
mbtf_pipeline.cost
mbtf_pipeline.cli
mbtf_pipeline
"""
RANK = {name: rank for rank, line in enumerate(ROOMS.split("\n")) for name in line.split()}
# What a package, or one of its rooms, may not import anywhere, not even inside a function.
FORBIDDEN = {
    "mbtf_core": {"torch", "mitsuba", "drjit", "trimesh"},
    "mbtf_gen": {"torch"},
    "mbtf_fit": {"mitsuba", "drjit", "mbtf_gen"},
    "mbtf_fit.backends.mitsuba": {"torch", "trimesh"},
    "mbtf_fit.preview": {"torch", "trimesh"},
    "mbtf_fit.comparison": {"mitsuba", "drjit"},
    "mbtf_pipeline": set(),
}


def room(module: str) -> str:
    """The line of the table that a module lies in."""
    parts = module.split(".")
    return next(name for n in range(len(parts), 0, -1) if (name := ".".join(parts[:n])) in RANK)


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


def third_party() -> dict[str, set[str]]:
    """Modules of others that the packages import, and where."""
    found: dict[str, set[str]] = {}
    for module in SOURCES:
        for name in imports_of(module):
            top = name.split(".")[0]
            if top not in sys.stdlib_module_names and top not in PACKAGES:
                found.setdefault(top, set()).add(module)
    return found


def test_what_is_imported_directly_is_installed_by_every_installation() -> None:
    """Modules of extras are imported by :func:`mbtf_core.extras.import_extra` alone."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    declared = {re.split(r"[^\w.-]", requirement)[0].lower() for requirement in project["dependencies"]}
    # Parts of Mitsuba, Jinja and Pydantic.
    allowed = {*declared, "drjit", "markupsafe", "pydantic_core"}
    providers = packages_distributions()
    undeclared = {
        name: where
        for name, where in third_party().items()
        if not allowed & {provider.lower() for provider in providers.get(name, [name])}
    }
    assert undeclared == {}


@cache
def imports_of(module: str) -> frozenset[str]:
    """What a module of ours imports."""
    return frozenset(imported(SOURCES[module].read_text()))


def faults(names: Iterable[str], module: str) -> list[str]:
    """Imports of a module that break the rules above."""
    own = room(module)
    forbidden = FORBIDDEN.get(own, FORBIDDEN[own.split(".")[0]])
    out = []
    for name in names:
        top = name.split(".")[0]
        if top in forbidden or (top in PACKAGES and RANK[room(name)] > RANK[own]):
            out.append(f"{module} imports {name}")
    return out


def test_imports_run_downwards() -> None:
    found = [fault for name in SOURCES for fault in faults(imports_of(name), name)]
    assert found == []


def graph_of(name_of: Callable[[str], str]) -> dict[str, set[str]]:
    """Who imports whom, of all sources by the names that `name_of` gives them."""
    graph: dict[str, set[str]] = {}
    for module in SOURCES:
        names = {name_of(name) for name in imports_of(module) if name in SOURCES}
        graph.setdefault(name_of(module), set()).update(names - {name_of(module)})
    return graph


@pytest.mark.parametrize("name_of", [lambda module: module, room], ids=["modules", "rooms"])
def test_no_circle(name_of: Callable[[str], str]) -> None:
    TopologicalSorter(graph_of(name_of)).prepare()


def public_classes() -> dict[str, list[str]]:
    """Modules that define a public class, by its name."""
    found: dict[str, list[str]] = {}
    for module, path in SOURCES.items():
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                found.setdefault(node.name, []).append(module)
    return found


def test_no_two_public_classes_share_a_name() -> None:
    assert {name: where for name, where in public_classes().items() if len(where) > 1} == {}


def test_commands_set_llvm_before_dr_jit_is_imported(run_python: RunPython) -> None:
    """Dr.Jit takes the system's LLVM, however old, if it is imported first."""
    names = "mbtf_fit.preview.sheet", "mbtf_fit.comparison", "mbtf_fit.training.fit", "mbtf_pipeline.run"
    imports = "; ".join(f"import {name}" for name in (*names, "sys"))
    done = run_python("-c", f"{imports}; print('drjit' in sys.modules)")
    assert done.stdout.strip() == "False", done.stderr
