"""Half precision: a material whose weights and texels are rounded to 16 bits, and its error."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from mbtf_core.errors import InputError
from mbtf_fit.material.material import Material, conformance_values


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

    def __str__(self) -> str:
        share = "" if self.relative is None else f" ({self.relative:.2g} of the rms value)"
        return (
            f"half precision: rms error {self.rms:.2g} 1/sr{share}, largest {self.largest:.2g} 1/sr, against "
            f"single precision on {self.count} conformance queries"
        )


def _round_to_half(name: str, tensor: Tensor) -> Tensor:
    """A tensor rounded to 16-bit floats, in single precision; single numbers stay as they are."""
    if tensor.ndim == 0:
        return tensor
    rounded = tensor.half().float()
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
    model = material.model.empty_copy()
    model.load_weights({name: _round_to_half(name, t) for name, t in material.model.weights().items()})
    transmittance = material.transmittance
    if transmittance is not None:
        levels = enumerate(map(torch.from_numpy, transmittance.levels))
        halves = [_round_to_half(f"transmittance.{s}", texels).numpy() for s, texels in levels]
        transmittance = replace(transmittance, levels=halves)
    before = material.conformance["rgb"].astype(np.float64)
    after = conformance_values(model, material.conformance)
    difference = after.astype(np.float64) - before
    rms, power = float(np.sqrt((difference**2).mean())), float(np.sqrt((before**2).mean()))
    error = HalfError(len(before), float(np.abs(difference).max()), rms, rms / power if power else None)
    conformance = {**material.conformance, "rgb": after}
    return replace(material, model=model, conformance=conformance, transmittance=transmittance), error
