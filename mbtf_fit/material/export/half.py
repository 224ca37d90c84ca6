"""Half precision: weights and texels rounded to 16 bits, and the rounding error."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mbtf_core.errors import InputError
from mbtf_fit.material.material import Material, conformance_values
from mbtf_fit.material.transmittance import Transmittance
from mbtf_fit.models.registry import build_model


@dataclass(frozen=True)
class HalfError:
    """Difference of half precision from single precision on the conformance queries.

    Attributes
    ----------
    count : queries
    largest : largest absolute difference, in 1/sr
    rms : root mean square difference, in 1/sr
    relative : that over the root mean square value; None where all values are 0
    """

    count: int
    largest: float
    rms: float
    relative: float | None

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return asdict(self)

    def __str__(self) -> str:
        share = "" if self.relative is None else f" ({self.relative:.2g} of the rms value)"
        return (
            f"half precision: rms error {self.rms:.2g} 1/sr{share}, largest {self.largest:.2g} 1/sr, against "
            f"single precision on {self.count} conformance queries"
        )


def round_to_half(name: str, tensor: Tensor) -> Tensor:
    """A tensor rounded to 16-bit floats; single numbers stay as they are.

    Raises
    ------
    InputError : a number is beyond their range
    """
    if tensor.ndim == 0:
        return tensor
    rounded = tensor.half()
    if not bool(rounded.isfinite().all()):
        raise InputError(
            f"'{name}' holds {float(tensor.abs().max()):.3g}, beyond half precision (65504)",
            hint="export it in single precision",
        )
    return rounded


def to_half(material: Material) -> tuple[Material, HalfError]:
    """The material with all weights and texels rounded to 16 bits, and the rounding error. Arithmetic stays
    in single precision; the conformance values become those of the rounded material.

    Raises
    ------
    InputError : a number is beyond half precision
    """
    weights = {name: round_to_half(name, t).float() for name, t in material.model.weights().items()}
    model = build_model(material.config.model, material.lattice, **material.config.network.model_dump())
    model.requires_grad_(False)
    model.load_weights(weights)
    queries = {name: array for name, array in material.conformance.items() if name != "rgb"}
    before = material.conformance["rgb"].astype(np.float64)
    after = conformance_values(model, queries)
    difference = after.astype(np.float64) - before
    rms, power = float(np.sqrt((difference**2).mean())), float(np.sqrt((before**2).mean()))
    error = HalfError(len(before), float(np.abs(difference).max()), rms, rms / power if power else None)
    return replace(
        material,
        model=model,
        conformance={**queries, "rgb": after},
        transmittance=_transmittance_to_half(material.transmittance),
    ), error


def _transmittance_to_half(transmittance: Transmittance | None) -> Transmittance | None:
    """The same with coefficients rounded to 16 bits."""
    if transmittance is None:
        return None
    levels = enumerate(transmittance.levels)
    return Transmittance(
        transmittance.lattice,
        [round_to_half(f"transmittance.{s}", torch.from_numpy(a)).float().numpy() for s, a in levels],
    )
