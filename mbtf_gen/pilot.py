"""A small run of the generator's own kernel that measures what a limit on interactions costs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .effects import EffectsPlan
from .estimates import Stream

if TYPE_CHECKING:
    from .generation import Job

# Queries of the pilot and paths of each.
PILOT_QUERIES, PILOT_SPP = 8192, 4


class Pilot:
    """A small run of the same kernel with other limits, on the same random numbers."""

    def __init__(self, job: Job, plan: EffectsPlan) -> None:
        rows = PILOT_QUERIES
        if job.config.queries.layout == "image":
            rows = max(1, rows // job.lattice.texels())
        queries = job.plan().draw("pilot", 0, rows).flat()
        some = slice(0, len(queries.sigma), max(1, len(queries.sigma) // PILOT_QUERIES))
        self.queries = type(queries)(
            queries.u[some], queries.sigma[some], queries.omega_i[some], queries.omega_o[some]
        )
        self.estimator = job.estimator(plan)
        self.seed = job.config.seed
        self.full = self._run(None)

    def _run(self, limit: int | None) -> Any:
        return self.estimator.estimate(self.queries, PILOT_SPP, Stream(self.seed, "pilot", 0), limit=limit)

    def cost(self, limit: int) -> tuple[float, float]:
        """(estimate, estimate plus two standard errors) of the cost of a limit on interactions."""
        cut = self._run(limit)
        a = (self.full.value_a - cut.value_a).astype(np.float64)
        b = (self.full.value_b - cut.value_b).astype(np.float64)
        # The product of the halves' changes is free of noise.
        square = np.mean(a * b, axis=-1)
        mean = float(np.mean(self.full.value_a + self.full.value_b)) / 2.0
        if mean <= 0.0:
            return 0.0, 0.0
        error = float(square.std()) / np.sqrt(len(square))
        low, high = max(float(square.mean()), 0.0), max(float(square.mean()) + 2.0 * error, 0.0)
        return float(np.sqrt(low)) / mean, float(np.sqrt(high)) / mean
