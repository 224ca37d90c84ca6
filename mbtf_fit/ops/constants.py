"""Constants of the operations, most of them defaults of their fields."""

from __future__ import annotations

import math
from collections.abc import Sequence

# Slope of leaky-relu below zero.
LEAK = 0.01
# Offset in tile widths per unit of the offset network's output.
OFFSET_SCALE = 0.1
# Cosine below which the offset no longer grows towards grazing views.
GRAZING = 0.6
# Rec.601 YUV → RGB, one row per color, as in NeuMIP's published code.
RGB_OF_YUV = ((1.0, 0.0, 1.13983), (1.0, -0.39465, -0.58060), (1.0, 2.03211, 0.0))
# Least value of the gate, so that its gradient never vanishes.
GATE = 0.1

# Of the model `relief`. Columns of the hints: height, irradiance, normal (x, y), core (RGB).
HINTS = 7
# Of the model `cloth`: columns about the fibers behind the hints, channels of their maps; bounds from below
# of the coverage, of cosines about the axis, of the variance of the lobe in rad².
FIBER_HINTS, FIBER_CHANNELS = 6, 7
LEAST_TANGENTS, LEAST_FIBER_COSINE, LEAST_FIBER_VARIANCE = 0.05, 0.02, 0.005
# Factor of the irradiance under the logarithm, and of heights in tile widths.
IRRADIANCE_SCALE, DEPTH_SCALE = 4.0, 10.0
# Channels of the maps: center of the slopes (x, y), moments about 0 (xx, xy, yy), base color (RGB); of glossy
# surfaces besides α² and metallic; of coated ones besides weight and α² of the clear coat.
DIFFUSE_CHANNELS, GLOSSY_CHANNELS, COATED_CHANNELS = MAP_CHANNELS = 8, 10, 12
# Azimuths of the horizons; share of the light kernel's width (RMS per axis) that blurs them.
AZIMUTHS, LIGHT_BLUR = 16, 0.8
# Distance in tile widths after which light below a surface is 1/e; between fibers, it goes deeper. Of 0.0015
# to 0.2, these fit test values of two stones and four cloths best, by regression on the hints.
LIGHT_DEPTH, CLOTH_LIGHT_DEPTH = 0.003, 0.04
# Smallest cosines of light and view to a normal, bounds of a lobe's own α², least variance of horizons.
LEAST_LIGHT, LEAST_VIEW, ALPHA2, LEAST_VARIANCE = 0.01, 0.05, (1e-6, 1.0), 1e-8
# Of GGX facets under a light of some width: multiples of the light's covariance that widen their tails, and
# of their own that widen the peak.
VOIGT_WIDENING, VOIGT_SCALE = 2.5, 0.6
# Of the squared cosine α² / (a + b α) that facets add to the albedo of a lobe at grazing angles: a and b.
ALBEDO_SPREAD = (0.06, 2.5)
# Tile borders that a view ray may cross; a ray at a cosine of 1e-4 crosses more above deep surfaces.
MAX_CROSSINGS = 64
# Offsets of the places from the footprint's center, across and along the view's azimuth, in σ; levels that
# lookups there are finer by. Lookups at one place have the footprint itself. Of offsets from 0.4 to 0.9 σ and
# levels from 0 to 1.5, these leave the least of test values to the network, by regression of those of six
# materials on the core. Places of the footprint's variance (√(3/4) σ and 1 level) leave more. Two places are
# apart across the view alone, which gives most of the gain. Eight and sixteen have 0.9 of the quantiles of a
# Gaussian in place of two values; spirals and other widths leave the same error.
_APART = 0.8 * math.sqrt(0.75)
_TWO, _FOUR = (-_APART, _APART), (-1.04, -0.29, 0.29, 1.04)


def _grid(across: Sequence[float], along: Sequence[float]) -> tuple[tuple[float, float], ...]:
    return tuple((x, y) for y in along for x in across)


PLACES: dict[int, tuple[tuple[tuple[float, float], ...], float]] = {
    1: (_grid((0.0,), (0.0,)), 0.0),
    2: (_grid(_TWO, (0.0,)), 1.0),
    4: (_grid(_TWO, _TWO), 1.25),
    8: (_grid(_FOUR, _TWO), 1.6),
    16: (_grid(_FOUR, _FOUR), 2.0),
}
# Of the model `neumip+`. Heights in tile widths per unit of the learned texture, and depth at its start.
# Bound from below, in gradients by the heights, of the view's cosine and of 1 - ∇h·ω_o,xy/ω_o,z.
HEIGHT_SCALE, FIRST_DEPTH, LEAST_FACING = 0.25, 0.04, 0.3
# Of the models `rainer2019` and `rainer2020`: channels besides the latents, mean and standard deviation of
# each color; smallest cosine of the light that values are divided by.
STATISTICS, LEAST_COSINE = 6, 0.01
# Largest ratio of the radii of a footprint in pictures, by default. At 5° above a plane the ratio is 11.
MAX_ANISOTROPY = 16.0
# Knots of the cosine in a fitted table of calibration factors: 0, 1/16, ..., 1.
KNOTS = 17
# Tensors of the surface in a material, before the level.
HEIGHTS, MAPS, HORIZONS = "surface.heights", "surface.maps", "surface.horizons"
FIBERS = "surface.fibers"
LIGHT_WIDTH, DIELECTRIC = "surface.light_width", "surface.dielectric"
