"""Exports of a material to other programs. A file of this folder that defines ``TARGET`` is a target.

Its name is a choice of ``mbtf-fit export --to``, its options are flags of the command. It imports heavy
libraries when it writes.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cyclopts import Group, Parameter

from mbtf_core.app.console import Console
from mbtf_fit.material.texture_formats import TextureFormat

if TYPE_CHECKING:
    from mbtf_fit.material.material import Material


def flags(group: str) -> Parameter:
    """Decorator of a dataclass whose fields, all optional, are flags in a group of the command's help."""
    return Parameter(name="*", group=Group(group, sort_key=0), show_default=False)


@dataclass
class Export:
    """One run of the command: what targets read and report.

    Attributes
    ----------
    source : the material's folder
    folder : where to write
    material : as it is written: rounded to the format
    form : of textures, to which the material is rounded
    console : for progress
    notes : lines for people, which targets add
    report : plain data for ``--json``, which targets add
    shared : results that several targets need, by any name
    """

    source: Path
    folder: Path
    material: Material
    form: TextureFormat
    console: Console
    notes: list[str] = field(default_factory=list)
    report: dict[str, Any] = field(default_factory=dict)
    shared: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ExportTarget:
    """A form that materials are exported to.

    Attributes
    ----------
    name : the choice of ``--to``
    help : what it is, for the help of the command
    files : names of all files that it may write
    write : writes them for an :class:`Export`, with its options, and returns the names of those written
    options : class whose fields are flags of the command; targets may share one
    rounds : whether it can be written with ``--texture-format``
    """

    name: str
    help: str
    files: Sequence[str]
    write: Callable[[Export, Any], list[str]]
    options: type[Any] | None = None
    rounds: bool = True


@cache
def targets() -> dict[str, ExportTarget]:
    """All targets by name."""
    modules = (
        importlib.import_module(f"{__name__}.{entry.name}") for entry in pkgutil.iter_modules(__path__)
    )
    found = (module.TARGET for module in modules if hasattr(module, "TARGET"))
    return {target.name: target for target in found}
