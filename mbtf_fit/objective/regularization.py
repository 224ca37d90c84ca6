"""Pulls towards 0 beside the gradients: how strong they are, and how they act.

Gone round often enough, few noisy queries are learned by heart. As the penalty of ridge regression does
(Hoerl and Kennard, Technometrics 12, 1970), both pulls grow with the ratio of noise to signal; that of the
networks' weights, which all queries have in common, falls with their number. They act apart from gradients
(Loshchilov and Hutter, ICLR 2019).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from mbtf_fit.config import TrainingSection
from mbtf_fit.models import NeuralMaterial

# Ratio of noise to signal from which on texels are pulled more than they are asked to be; below it weights
# are pulled less, so that few but clean queries are learned from freely.
_PLAIN_NOISE = 0.5
# Strongest pull of the weights.
_MOST = 1.0


@dataclass(frozen=True)
class Pull:
    """By the rate times this per step.

    Attributes
    ----------
    texels : of the textures; weights : of the networks' matrices
    """

    texels: float
    weights: float

    @classmethod
    def of(cls, training: TrainingSection, ratio: float, queries: int) -> Pull:
        """For so many training queries, whose noise variance is `ratio` times that of their true values."""
        doubt = ratio / _PLAIN_NOISE
        weights = training.weight_decay * ratio * min(1.0, doubt) / queries
        return cls(training.decay * max(1.0, doubt), min(_MOST, weights))

    def act(self, model: NeuralMaterial, texture_rate: float, rate: float) -> None:
        """Shrink a model's parameters by one step at these rates."""
        texels, weights = model.parameter_groups()
        # Biases hold the value that is left when all else has shrunk.
        matrices = [p for p in weights if p.ndim > 1]
        with torch.no_grad():
            for parameters, amount in ((texels, texture_rate * self.texels), (matrices, rate * self.weights)):
                if amount > 0:
                    for p in parameters:
                        p.mul_(math.exp(-amount))
