"""Materials whose numbers are rounded to a format of textures, and what that costs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from mbtf_core.errors import InputError
from mbtf_fit.material.material import Material, conformance_values
from mbtf_fit.material.texture_formats import QUANTIZED, TextureFormat, grouped, round_levels


@dataclass(frozen=True)
class RoundingError:
    """Difference of a rounded material from single precision on the conformance queries.

    Attributes
    ----------
    form : of the textures, or how they are stored
    count : queries
    largest : largest absolute difference, in 1/sr
    rms : root mean square difference, in 1/sr
    relative : that over the root mean square value; None where all values are 0
    """

    form: str
    count: int
    largest: float
    rms: float
    relative: float | None

    @classmethod
    def between(cls, form: str, before: ArrayLike, after: ArrayLike) -> RoundingError:
        """Of values (n, 3) before and after."""
        exact = np.asarray(before, np.float64)
        difference = np.asarray(after, np.float64) - exact
        rms, power = float(np.sqrt((difference**2).mean())), float(np.sqrt((exact**2).mean()))
        largest = float(np.abs(difference).max())
        return cls(form, len(exact), largest, rms, rms / power if power else None)

    def __str__(self) -> str:
        share = "" if self.relative is None else f" ({self.relative:.2g} of the rms value)"
        return (
            f"{self.form}: rms error {self.rms:.2g} 1/sr{share}, largest {self.largest:.2g} 1/sr, against "
            f"the material as it is, on {self.count} conformance queries"
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


def round_weights(weights: Mapping[str, Tensor], form: TextureFormat) -> dict[str, Tensor]:
    """Tensors by name as readers of a format get them: half precision rounds all, other formats textures.

    Raises
    ------
    InputError : a number is beyond half precision
    """
    if form not in QUANTIZED:
        return {n: t if form == "float32" else _round_to_half(n, t) for n, t in weights.items()}
    out = dict(weights)
    for texture, names in grouped(weights).items():
        levels = round_levels(texture, [weights[name].cpu().numpy() for name in names], form)
        out |= {n: torch.from_numpy(x).to(weights[n].device) for n, x in zip(names, levels, strict=True)}
    return out


def round_material(material: Material, form: TextureFormat) -> tuple[Material, RoundingError]:
    """The material with its numbers rounded, and the rounding error. Arithmetic stays in single precision;
    the conformance values become those of the rounded material. The transmittance is rounded to half
    precision.

    Raises
    ------
    InputError : a number is beyond half precision
    """
    model, weights = material.model.empty_copy(), material.model.weights()
    model.load_weights(round_weights(weights, form))
    transmittance = material.transmittance
    if transmittance is not None and form != "float32":
        layers = [
            [_round_to_half("transmittance", torch.from_numpy(texels)).numpy() for texels in levels]
            for levels in transmittance.layers
        ]
        transmittance = replace(transmittance, layers=layers)
    after = conformance_values(model, material.conformance)
    error = RoundingError.between(form, material.conformance["rgb"], after)
    conformance = {**material.conformance, "rgb": after}
    return replace(material, model=model, conformance=conformance, transmittance=transmittance), error
