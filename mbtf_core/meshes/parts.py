"""What holds of a shape of any format: images need texture coordinates, colors of vertices a range."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_core.meshes.content import MeshShape

I64 = NDArray[np.int64]
_HINT = "give {role} in a material.yaml, or correct the file"


def groups_of(key: I64) -> list[I64]:
    """Indices that share a value, for each of the values in ascending order."""
    order = np.argsort(key, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(key[order])) + 1)


def part_of(shape: MeshShape, path: Path, warnings: list[str]) -> MeshShape:
    """A shape with faults where its values and its arrays contradict each other.

    Images take precedence over colors of vertices; colors that are all white are none.

    Parameters
    ----------
    shape : MeshShape
        As it was read.
    path : Path
        Its file.
    warnings : list of str
        Warnings are added.
    """
    values, faults, colors = dict(shape.values), dict(shape.faults), shape.colors
    for role, value in shape.values.items():
        if isinstance(value, tuple) and shape.uv is None:
            what = f"'{shape.name}' has an image of {role} and triangles without texture coordinates"
            faults[role] = InputError(what, where=path, hint=_HINT.format(role=role))
    if colors is not None and np.all(colors == 1.0):
        colors = None
    if colors is not None:
        base = values.setdefault("base_color", np.ones(3))
        if not (np.isfinite(colors).all() and colors.min() >= 0.0 and colors.max() <= 1.0):
            what = f"'{shape.name}' has colors of vertices outside [0, 1]"
            faults["base_color"] = InputError(what, where=path, hint=_HINT.format(role="base_color"))
            colors = None
        elif isinstance(base, tuple):
            warnings.append(f"'{shape.name}' has an image: the colors of its vertices are not used")
            colors = None
        elif np.any(base != 1.0):
            warnings.append(f"'{shape.name}': its color multiplies the colors of its vertices")
    return replace(shape, values=values, faults=faults, colors=colors)
