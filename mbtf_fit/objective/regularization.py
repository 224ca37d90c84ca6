"""Weight decay of textures and network weights, decoupled from the gradients.

After many epochs a network overfits the noise of few queries. As the penalty of ridge regression does (Hoerl
and Kennard, Technometrics 12, 1970), both decays grow with the noise-to-signal ratio. The decay of the
network weights, which all queries share, falls with the number of queries. Both are applied to the parameters
themselves, not to the gradients (Loshchilov and Hutter, ICLR 2019).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from mbtf_fit.pytorch.material import NeuralMaterial
from mbtf_fit.sections import TrainingSection

# Noise-to-signal ratio above which the decay of texels grows. Below it the decay of weights falls
# quadratically, so that few but clean queries are fitted without bias.
_REFERENCE_NOISE = 0.5
# Largest decay of the network weights.
_MOST = 1.0


@dataclass(frozen=True)
class WeightDecay:
    """Decay per step, relative to the learning rate: of the textures, and of the networks' matrices."""

    texels: float
    weights: float

    @classmethod
    def of(cls, training: TrainingSection, noise_ratio: float, queries: int) -> WeightDecay:
        """Decay for a number of training queries with a noise-to-signal ratio (of variances)."""
        relative = noise_ratio / _REFERENCE_NOISE
        weights = training.noise_regularization * noise_ratio * min(1.0, relative) / queries
        return cls(training.texture_weight_decay * max(1.0, relative), min(_MOST, weights))

    def apply(self, model: NeuralMaterial, texture_rate: float, rate: float) -> None:
        """Decay a model's parameters by one step at these learning rates."""
        texels, weights = model.parameter_groups()
        # Biases do not decay: they keep the mean value.
        matrices = [p for p in weights if p.ndim > 1 and p.requires_grad]
        with torch.no_grad():
            for parameters, amount in ((texels, texture_rate * self.texels), (matrices, rate * self.weights)):
                if amount > 0:
                    for p in parameters:
                        p.mul_(math.exp(-amount))
