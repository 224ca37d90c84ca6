"""Weight decay: its strength follows noise and number of the queries, and biases are exempt."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from support.fit_data import parallax, random_queries, write_data

from mbtf_core.data.lattice import Lattice
from mbtf_fit.config import FitConfig, ModelName, build_model
from mbtf_fit.data.loader import load_training, open_data
from mbtf_fit.sections import TrainingSection
from mbtf_fit.training.trainer import WeightDecay, prepare_trainer

LATTICE = Lattice(3)


@pytest.mark.parametrize(
    ("ratio", "queries", "strength", "texels", "weights"),
    [
        (0.0, 5000, 1000.0, 2.0, 0.0),
        (0.4, 5000, 1000.0, 2.0, 0.064),
        (2.0, 5000, 1000.0, 8.0, 0.4),
        (5.0, 10, 0.0, 20.0, 0.0),
        (5.0, 50, 1000.0, 20.0, 1.0),
    ],
)
def test_noise_increases_weight_decay(
    ratio: float, queries: int, strength: float, texels: float, weights: float
) -> None:
    """Of texels from a ratio of a half on; of weights with its square up to there, then with it, over the
    number of queries; at most 1, or few queries would decay all weights to 0."""
    section = TrainingSection(texture_weight_decay=2.0, noise_regularization=strength)
    found = WeightDecay.of(section, ratio, queries)
    assert (found.texels, found.weights) == (pytest.approx(texels), pytest.approx(weights))


@pytest.mark.parametrize("model", ["neumip", "neumip-baseline", "hierarchical"])
def test_texels_and_matrices_decay_and_biases_do_not(model: ModelName) -> None:
    found = build_model(model, LATTICE)
    with torch.no_grad():
        for p in found.parameters():
            p.fill_(1.0)
    WeightDecay(texels=3.0, weights=2.0).apply(found, 0.1, 0.01)
    texels, _ = found.parameter_groups()
    for name, p in found.named_parameters():
        texel = any(p is t for t in texels)
        matrix = not texel and p.ndim > 1
        assert matrix == ("weight" in name)
        expected = np.exp(-0.3) if texel else np.exp(-0.02) if matrix else 1.0
        torch.testing.assert_close(p.detach(), torch.full_like(p, expected))


def test_a_fit_estimates_the_noise_ratio_of_its_data(tmp_path: Path) -> None:
    """Noise of 0.02 in each half is 2e-4 of variance in their mean."""
    folder = write_data(tmp_path / "data", parallax, train=20_000, noise=0.02)
    training = {"noise_regularization": 1000.0, "texture_weight_decay": 1.0}
    config = FitConfig.model_validate({"training": training})
    data = open_data(folder, "shuffled", "neumip")
    partition = load_training(data, config.held_out, config.seed, config.data.memory)
    trainer = prepare_trainer(config, data, partition, torch.device("cpu"))
    arrays = random_queries(np.random.default_rng(5), 20_000, LATTICE)
    ratio = 2e-4 / parallax(*arrays.values()).var(0).mean()
    assert ratio > 0.5
    n = len(partition.training)
    assert trainer.weight_decay.weights == pytest.approx(1000 * ratio / n, rel=0.1)
    assert trainer.weight_decay.texels == pytest.approx(2 * ratio, rel=0.1)
