"""ST-LPIPS of an image against its reference: a learned perceptual distance.

Ghildyal and Liu: "Shift-tolerant Perceptual Similarity Metric", ECCV 2022. The weights are those of the
package ``stlpips-pytorch`` (network ``alex``), an optional extra. Its code is not used, because its
dependencies would install another PyTorch. The network consists of AlexNet's convolutions; a 1 2 1 blur
replaces their strides. Features of five layers are normalized over channels. Their squared differences are
weighted per channel and averaged over positions.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.color import linear_to_srgb
from mbtf_core.errors import EngineError

if TYPE_CHECKING:
    from torch import Tensor

PACKAGE = "stlpips_pytorch"
_WEIGHTS = Path("weights/vST0.0/alex_shift_tolerant.pth")
# Smallest image side for which the deepest layer is not empty.
_SMALLEST = 32

DEFINITION = (
    "ST-LPIPS (Ghildyal and Liu 2022, network alex) of the images in sRGB, with values above white "
    "clipped; 0 means equal. It includes the reference noise; its two estimates, compared, give a baseline."
)


def to_srgb(image: ArrayLike, white: float) -> NDArray[np.float64]:
    """sRGB in [0, 1] of linear values (..., 3) in 1/sr, clipped at `white`."""
    linear = np.clip(np.asarray(image, np.float64) / white, 0.0, 1.0)
    return np.asarray(linear_to_srgb(linear), np.float64)


def weights_file() -> Path | None:
    """Path of the package's weights; None if it is not installed."""
    spec = find_spec(PACKAGE)
    places = (spec and spec.submodule_search_locations) or []
    return next((path for place in places if (path := Path(place) / _WEIGHTS).is_file()), None)


def require() -> Path:
    """Path of the weights.

    Raises
    ------
    EngineError : the package with its weights is not installed
    """
    file = weights_file()
    if file is None:
        raise EngineError(
            "ST-LPIPS needs the weights of the package stlpips-pytorch, which is not installed",
            where="compare.st_lpips",
            hint="pip install 'mbtf[perceptual]', or remove the option",
        )
    return file


@dataclass(frozen=True)
class _Network:
    """Tensors of the network, named as in the package's file."""

    tensors: dict[str, Any]

    def _layer(self, x: Tensor, name: str, padding: int) -> Tensor:
        from torch.nn.functional import conv2d

        return conv2d(x, self.tensors[f"{name}.weight"], self.tensors[f"{name}.bias"], padding=padding)

    def _blurred(self, x: Tensor) -> Tensor:
        """1 2 1 blur with stride 2 and reflected edges, two pixels wide."""
        import torch
        from torch.nn.functional import conv2d, pad

        row = torch.tensor([0.25, 0.5, 0.25])
        kernel = (row[:, None] * row).expand(x.shape[1], 1, 3, 3)
        return conv2d(pad(x, (2, 2, 2, 2), mode="reflect"), kernel, stride=2, groups=x.shape[1])

    def _pooled(self, x: Tensor) -> Tensor:
        """Maximum over 3 × 3, then blurred with stride 2."""
        from torch.nn.functional import max_pool2d

        return self._blurred(max_pool2d(x, 3, stride=1))

    def features(self, x: Tensor) -> list[Tensor]:
        """Features of the five layers for images (n, 3, rows, columns) in [-1, 1]."""
        x = (x - self.tensors["scaling_layer.shift"]) / self.tensors["scaling_layer.scale"]
        first = self._blurred(self._layer(x, "net.slice1.0", 2)).relu()
        second = self._layer(self._pooled(first), "net.slice2.5", 2).relu()
        third = self._layer(self._pooled(second), "net.slice3.9", 1).relu()
        fourth = self._layer(third, "net.slice4.11", 1).relu()
        return [first, second, third, fourth, self._layer(fourth, "net.slice5.13", 1).relu()]

    def distance(self, first: Tensor, second: Tensor) -> float:
        """Distance of two images (1, 3, rows, columns)."""
        total = 0.0
        for layer, (x, y) in enumerate(zip(self.features(first), self.features(second), strict=True)):
            x, y = (f / (f.square().sum(1, keepdim=True).sqrt() + 1e-10) for f in (x, y))
            weights = self.tensors[f"lin{layer}.model.1.weight"].view(1, -1, 1, 1)
            total += float(((x - y).square() * weights).sum(1).mean())
        return total


@lru_cache(maxsize=1)
def _network() -> _Network:
    import torch

    return _Network(torch.load(require(), map_location="cpu", weights_only=True))


def st_lpips(image: ArrayLike, reference: ArrayLike, white: float) -> float | None:
    """ST-LPIPS of linear images (rows, columns, 3) in 1/sr; None for images too small for the network.

    Parameters
    ----------
    white : linear value displayed as white, 1/sr

    Raises
    ------
    EngineError : the package with its weights is not installed
    """
    import torch

    network = _network()
    if min(np.shape(reference)[:2]) < _SMALLEST:
        return None
    pair = [
        torch.from_numpy((2.0 * to_srgb(x, white) - 1.0).astype(np.float32).transpose(2, 0, 1)[None])
        for x in (image, reference)
    ]
    with torch.no_grad():
        return network.distance(*pair)
