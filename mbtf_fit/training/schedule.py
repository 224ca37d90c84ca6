"""Schedules of the learning rates and of the blur over a fraction of the budget."""

from __future__ import annotations

import math

from mbtf_fit.config import BlurSection, TrainingSection
from mbtf_fit.models.blur import annealed_sigma
from mbtf_fit.models.interface import NeuralMaterial

# Widest blur, in tile widths. A blur of half a tile made training unstable on textures of 16 × 16 texels: the
# offsets of three of eight fits diverged before the textures became sharp.
WIDEST_BLUR = 0.125


def learning_rate_factor(training: TrainingSection, step: int, fraction: float) -> float:
    """Factor of the learning rates after a fraction of the budget: linear warm-up, then cosine decay."""
    rise = min(1.0, (step + 1) / (training.warmup + 1))
    last = training.final_learning_rate_factor
    fall = last + (1 - last) * 0.5 * (1 + math.cos(math.pi * min(fraction, 1.0)))
    return rise * fall


def blur_sigmas(blur: BlurSection, model: NeuralMaterial, fraction: float) -> list[float]:
    """Blur of each texture after a fraction of the budget, in texels of the finest level."""
    start = min(blur.initial_sigma, max(WIDEST_BLUR * min(model.lattice.shape()), blur.final_sigma))
    sigma = annealed_sigma(fraction / blur.fraction, start, blur.final_sigma)
    return [max(sigma, blur.offset_sigma if t.moves_lookups else blur.min_sigma) for t in model.textures()]
