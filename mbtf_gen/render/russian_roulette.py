"""Russian roulette: paths end at random, without bias, where little throughput is left (Arvo and Kirk 1990,
"Particle Transport and Image Synthesis").
"""

from __future__ import annotations

import drjit as dr

from mbtf_gen.render.types import Float, UInt32

# Paths of throughput one always survive up to this many interactions: in white cracks, dividing by smaller
# survival probabilities would let their weights grow without bound. Later they survive with LATE_SURVIVAL.
LATE_DEPTH = 64
LATE_SURVIVAL = 0.995
# Survival probability over throughput. Interactions after the first take half of the time and contribute a
# tenth of the variance; on stone, cloth, metal and bark, 2 was cheaper than 1 and 4.
SURVIVAL_PER_THROUGHPUT = 2.0
# Random numbers are multiples of 2^-24, which approximate smaller probabilities coarsely.
LEAST_SURVIVAL = 2.0**-10
# A path sampled from a lobe at least this narrow (density in 1/sr) may carry light that light sampling
# misses: Russian roulette starts this many interactions later.
NARROW_PDF = 4.0
NARROW_EXTRA_DEPTH = 2


def survival_probability(strongest: Float, depth: UInt32, pdf: Float, start: UInt32) -> Float:
    """Survival probability of Russian roulette, from the largest channel of the throughput.

    Both densities of the balance heuristic include it. Otherwise, on dark surfaces, light found by BSDF
    sampling would be carried by the few paths that survive, with large weights.
    """
    largest = dr.select(depth < LATE_DEPTH, 1.0, LATE_SURVIVAL)
    likely = dr.clip(SURVIVAL_PER_THROUGHPUT * strongest, LEAST_SURVIVAL, largest)
    start = dr.select(pdf > NARROW_PDF, start + NARROW_EXTRA_DEPTH, start)
    return dr.select(depth >= start, likely, 1.0)
