"""Statistics of Monte Carlo data: noise from halves, errors free of noise, tests.

Needs numpy and scipy alone. ``docs/explanation/statistics.md`` explains when to use which.
"""

from mbtf_core.stats.estimate import (
    SIGNIFICANT,
    Estimate,
    Outcome,
    by_group,
    elevation_groups,
    is_significant,
    level_groups,
    mean_estimate,
    ratio_of,
    t_test,
)
from mbtf_core.stats.paired import (
    local_error,
    mean_of_halves,
    mse_difference,
    noise_free_mse,
    pooled_error,
    pooled_relative_error,
    pooled_variance,
    psnr,
    signal_variance,
    unexplained_variance,
)

__all__ = [
    "SIGNIFICANT",
    "Estimate",
    "Outcome",
    "by_group",
    "elevation_groups",
    "is_significant",
    "level_groups",
    "local_error",
    "mean_estimate",
    "mean_of_halves",
    "mse_difference",
    "noise_free_mse",
    "pooled_error",
    "pooled_relative_error",
    "pooled_variance",
    "psnr",
    "ratio_of",
    "signal_variance",
    "t_test",
    "unexplained_variance",
]
