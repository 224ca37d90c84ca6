"""Noise of a data set, and errors of two predictions with their error bars.

Run it beside a data set `shards/`.
"""

import numpy as np

from mbtf_core.stats import (
    by_group,
    level_groups,
    mse_difference,
    noise_free_mse,
    pooled_relative_error,
    t_test,
    unexplained_variance,
)
from mbtf_gen import Dataset

train, test = (Dataset.open("shards").load(split) for split in ("train", "test"))
a, b = test["value_a"], test["value_b"]
# Weights of test queries that are drawn by highlights (of glossy materials and cloth).
weight = test.get("weight")
levels = level_groups(test["sigma"])

print("noise of one query:", pooled_relative_error(a, b, weight))

# Two predictions: a constant, and a linear function of the view's cosine.
constant = np.broadcast_to(train["value_a"].mean(axis=0), a.shape)
basis = np.stack([np.ones(len(train["sigma"])), train["omega_o"][:, 2]], axis=1)
weights, *_ = np.linalg.lstsq(basis, (train["value_a"] + train["value_b"]) / 2, rcond=None)
shaded = np.stack([np.ones(len(a)), test["omega_o"][:, 2]], axis=1) @ weights

for name, prediction in (("constant", constant), ("shaded", shaded)):
    print(name, "error:", noise_free_mse(prediction, a, b, weight))
    for level, share in by_group(unexplained_variance, levels, prediction, a, b, weight).items():
        print(f"  unexplained at level {level}: {share}")

# Is the second one better? The paired difference cancels the noise of the reference.
better = t_test(mse_difference(shaded, constant, a, b, weight), alternative="less")
print("shaded is better:", better)

# Does the prediction agree with the data? Its error without noise would be zero.
verdict = t_test(noise_free_mse(shaded, a, b, weight), alternative="greater")
print("same values:", verdict)
