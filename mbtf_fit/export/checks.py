"""Checks of written exports: what they hold must give the material's conformance values.

A file that fails is removed.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.errors import InputError, reason

if TYPE_CHECKING:
    from mbtf_fit.material.material import Material

# Deviation from the sum of the value and the mean value, and the share of the queries that may exceed it: in
# another order of operations, a traced ray may pass an edge on the other side.
_TOLERANCE, _EDGES = 1e-3, 0.02


def check_values(found: ArrayLike, material: Material, where: Path) -> None:
    """Refuse values (n, 3) at the conformance queries that are not those of a material.

    Raises
    ------
    InputError : more than 2% of them deviate by more than 0.001 of value and mean value, or are not finite
    """
    expected: NDArray[np.float64] = material.conformance["rgb"].astype(np.float64)
    with np.errstate(invalid="ignore"):
        apart = np.abs(np.asarray(found, np.float64) - expected)
    wrong = ~(apart <= _TOLERANCE * (expected + expected.mean())).all(1)
    if wrong.mean() > _EDGES:
        worst = float(np.nan_to_num(apart, nan=np.inf).max())
        where.unlink(missing_ok=True)
        raise InputError(
            f"{wrong.sum()} of {len(wrong)} conformance values differ, by up to {worst:.2g} 1/sr",
            where=where,
            hint="the file was removed; an operation computes something else in its reader",
        )


def check_stored(
    about: Mapping[str, Any], tensors: Mapping[str, ArrayLike], material: Material, where: Path
) -> None:
    """Evaluate a written list of operations by NumPy alone (:mod:`mbtf_fit.material.numpy_reader`).

    Parameters
    ----------
    about : operations and shapes, as written
    tensors : by name, as written
    where : the file that has been written

    Raises
    ------
    InputError : an operation is not one of the project's, a tensor is missing, or values differ
    """
    from mbtf_fit.material.format import QUERY
    from mbtf_fit.material.numpy_reader import NumpyMaterial

    queries = (material.conformance[name] for name in QUERY)
    try:
        with np.errstate(all="ignore"):
            found = NumpyMaterial(about, tensors).evaluate(*queries)
    except NotImplementedError as error:
        where.unlink(missing_ok=True)
        hint = "readers of this format have the project's operations; export with: --to material"
        raise InputError(str(error), where=where, hint=hint) from None
    except Exception as error:  # whatever the operations make of the numbers
        where.unlink(missing_ok=True)
        raise InputError(f"cannot be evaluated by NumPy ({reason(error)})", where=where) from error
    check_values(found, material, where)


def check_shaders(material: Material, where: Path) -> None:
    """Refuse operations whose shader code is not the project's, which its tests do not run.

    Raises
    ------
    InputError : names the operation
    """
    from mbtf_fit.backends.shader.program import SHADER

    for operation in material.model.stored_operations():
        if not SHADER[operation].__module__.startswith("mbtf_fit."):
            raise InputError(
                f"the shader code of the operation '{operation.kind()}' is from another package, unchecked",
                where=where,
                hint="leave this format out",
            )
