"""Parts of meshes: their triangles, and the colors of their vertices."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_core.meshes.content import MeshShape

I64 = NDArray[np.int64]


def groups_of(key: I64) -> list[I64]:
    """Indices that share a value, for each of the values in ascending order."""
    order = np.argsort(key, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(key[order])) + 1)


def with_colors(shape: MeshShape, path: Path, warnings: list[str]) -> MeshShape:
    """A shape whose colors of vertices go with its base color.

    Images take precedence over colors of vertices; colors that are all white are none.

    Parameters
    ----------
    shape : as it was read
    path : its file
    warnings : warnings are added
    """
    colors, base = shape.colors, shape.values.get("base_color")
    if colors is None or np.all(colors == 1.0):
        return replace(shape, colors=None)
    if isinstance(base, tuple):
        warnings.append(f"'{shape.name}' has an image: the colors of its vertices are not used")
        return replace(shape, colors=None)
    if not (np.isfinite(colors).all() and colors.min() >= 0.0 and colors.max() <= 1.0):
        fault = InputError(
            f"'{shape.name}' has colors of vertices outside [0, 1]",
            where=path,
            hint="correct them, or give base_color in a material.yaml",
        )
        return replace(shape, colors=None, faults={**shape.faults, "base_color": fault})
    if base is not None and np.any(base != 1.0):
        warnings.append(f"'{shape.name}': its color multiplies the colors of its vertices")
    return replace(shape, values={"base_color": np.ones(3), **shape.values})
