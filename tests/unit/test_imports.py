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
# The rooms of each package from the lowest to the highest: folders or single files. A room imports from those
# before it; a comma joins two that stand side by side. A dot stands for the files that no room names.
ROOMS = {
    "mbtf_core": ". config files run app images meshes data stats pictures",
    "mbtf_gen": "sampling measured engine config tile.tracers tile.heights tile.fibers tile.maps tile render"
    " diagnostics planning generation pictures publishing cli .",
    "mbtf_fit": "sections formatting threads ops data native surface pytorch objective backends.cpu models"
    " config material maps evaluation training backends.mitsuba backends.shader pictures"
    " viewer export cli .",
    "mbtf_pipeline": "recipe compare stages tables report run collection cost cli .",
}
RANK = {
    f"{package}.{name}".removesuffix(".."): rank
    for rank, (package, names) in enumerate((p, names) for p, line in ROOMS.items() for names in line.split())
    for name in names.split(",")
}
# What a package, or one of its rooms, may not import anywhere, not even inside a function.
FORBIDDEN = {
    "mbtf_core": {"torch", "mitsuba", "drjit", "trimesh"},
    "mbtf_gen": {"torch"},
    "mbtf_fit": {"mitsuba", "drjit", "mbtf_gen"},
    "mbtf_fit.backends.mitsuba": {"torch", "trimesh"},
    "mbtf_fit.pictures": {"torch", "trimesh"},
    "mbtf_fit.pictures.comparison": {"mitsuba", "drjit"},
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
    names = (
        "mbtf_fit.pictures.sheet",
        "mbtf_fit.pictures.comparison",
        "mbtf_fit.training.fit",
        "mbtf_pipeline.run",
    )
    imports = "; ".join(f"import {name}" for name in (*names, "sys"))
    done = run_python("-c", f"{imports}; print('drjit' in sys.modules)")
    assert done.stdout.strip() == "False", done.stderr
