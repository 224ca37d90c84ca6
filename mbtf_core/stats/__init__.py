"""Statistics of Monte Carlo data: noise from halves, errors free of noise, tests, χ² of samplers.

Needs numpy and scipy alone. The documentation's page on statistics explains when to use which.
"""

from mbtf_core.stats.aggregate import Aggregate, Comparison, aggregate_test
from mbtf_core.stats.chi_square import Cap, ChiSquare, Domain, Rectangle, chi_square_test
from mbtf_core.stats.estimate import Estimate, mean_estimate, paired_difference
from mbtf_core.stats.groups import by_group, elevation_groups, level_groups
from mbtf_core.stats.paired import (
    mean_of_halves,
    mse_difference,
    noise_free_mse,
    pooled_error,
    pooled_relative_error,
    pooled_variance,
    signal_variance,
    unexplained_variance,
)
from mbtf_core.stats.significance import Outcome, equivalence_test, holm, sidak, t_test, z_test

__all__ = [
    "Aggregate",
    "Cap",
    "ChiSquare",
    "Comparison",
    "Domain",
    "Estimate",
    "Outcome",
    "Rectangle",
    "aggregate_test",
    "by_group",
    "chi_square_test",
    "elevation_groups",
    "equivalence_test",
    "holm",
    "level_groups",
    "mean_estimate",
    "mean_of_halves",
    "mse_difference",
    "noise_free_mse",
    "paired_difference",
    "pooled_error",
    "pooled_relative_error",
    "pooled_variance",
    "sidak",
    "signal_variance",
    "t_test",
    "unexplained_variance",
    "z_test",
]
