"""Self-test of the physics on the user's machine: ``mbtf-gen selftest``.

Every check measures quantities whose true values are known, on the generator's own estimator. It passes if
the error of each case is at most its tolerance plus 4.5 standard errors.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.data.schema import Queries
from mbtf_core.directions import from_angles
from mbtf_core.errors import EngineError
from mbtf_core.stats import mean_estimate
from mbtf_gen.diagnostics.checks import Check
from mbtf_gen.engine.runtime import load_mitsuba
from mbtf_gen.sampling.light_kernel import LightKernel
from mbtf_gen.tile.heights import HeightGrid

F64 = NDArray[np.float64]

# Exceeded by one normal error in 150 000: with a hundred cases, one false alarm in 1500 runs.
STANDARD_ERRORS = 4.5

_UP = from_angles(90.0, 0.0)
_PLANE = HeightGrid(np.zeros((4, 4)), 1.0)
_PAIRS = [((70, 0), (80, 0)), ((35, 10), (50, 200)), ((20, 180), (60, 30)), ((15, 60), (25, 75))]
_GRAZING = (1.0, 0.1, 1e-2, 1e-4)


class Case(NamedTuple):
    """Measured minus true value, relative to it, or a count; and its standard error, 0 without noise."""

    off: float
    error: float = 0.0


def verdict(tolerance: float, cases: Mapping[str, Case]) -> str:
    """The case closest to its limit, in words; an EngineError with the same if a case is beyond its limit:
    the tolerance plus :data:`STANDARD_ERRORS`."""
    limits = {name: tolerance + STANDARD_ERRORS * case.error for name, case in cases.items()}
    good = {name: math.isfinite(case.error) and abs(case.off) <= limits[name] for name, case in cases.items()}
    # A limit of zero is exact.
    name = max(good, key=lambda n: (not good[n], abs(cases[n].off) / (limits[n] or 1.0)))
    off, error = cases[name]
    random = f" ± {error:.1e}" if error else ""
    found = f"off by {abs(off):.1e}{random} of at most {limits[name]:.1e} ({name}; {len(cases)} cases)"
    if not all(good.values()):
        raise EngineError(found)
    return found


def all_checks() -> list[Check]:
    """Every check, in the order in which they are reported."""
    known = {
        "Lambert plane": (1e-4, _lambert),
        "V-groove": (1e-3, _groove),
        "furnace": (2e-4, _furnace),
        "reciprocity": (2e-3, _reciprocity),
        "surface energy": (2e-3, _surface),
        "periodicity": (0.0, _lost),
    }

    def check(tolerance: float, measure: Callable[[], Mapping[str, Case]]) -> str:
        return verdict(tolerance, measure())

    return [Check(name, partial(check, *of)) for name, of in known.items()]


@dataclass(frozen=True)
class Groove:
    """A symmetric V-groove along y: ridges at x = 1/4 + n, valleys at x = 3/4 + n.

    Lambertian under a delta light of unit irradiance on the reference plane, with direct light alone. The
    radiance of a lit facet of normal n is ``albedo/π · (n·ω_i)/ω_i,z`` in every direction; straight lines
    past the ridges bound its lit and its visible part.

    Attributes
    ----------
    depth : depth of the valleys, in tile widths
    albedo : of both facets
    """

    depth: float
    albedo: float

    @property
    def grid(self) -> HeightGrid:
        """The heights: two columns."""
        return HeightGrid(np.tile([0.0, -self.depth], (2, 1)), 1.0)

    @property
    def slope(self) -> float:
        """Slope of the facets."""
        return 2.0 * self.depth

    def reach(self, omega: F64, side: int) -> float:
        """Depth down to which the facet that descends towards `side`·x is visible from direction ω (3,)."""
        if side * self.slope * omega[0] + omega[2] <= 0:
            return 0.0
        # At depth d the facet is d/slope from its ridge; the opposite ridge, one tile on, is passed when
        # d/slope + d·ω_x/ω_z ≤ 1.
        run = 1.0 / self.slope + side * omega[0] / omega[2]
        return self.depth if run <= 0 else min(self.depth, 1.0 / run)

    def radiance(self, omega_i: F64, side: int) -> float:
        """Radiance of the lit part of the facet that descends towards `side`·x, in 1/sr."""
        cosine = (side * self.slope * omega_i[0] + omega_i[2]) / np.hypot(1.0, self.slope)
        return float(self.albedo / np.pi * max(0.0, cosine) / omega_i[2])

    def tile_mean(self, omega_i: ArrayLike, omega_o: ArrayLike) -> float:
        """Tile mean in 1/sr for directions (3,)."""
        light, view = np.asarray(omega_i, np.float64), np.asarray(omega_o, np.float64)
        total = 0.0
        for side in (1, -1):
            both = min(self.reach(light, side), self.reach(view, side))
            # The shadow of a facet's depth d on the reference plane, along the view.
            length = both * (1.0 / self.slope + side * view[0] / view[2])
            total += self.radiance(light, side) * length
        return total


def terraces() -> HeightGrid:
    """A periodic height field with terraces, steep flanks and no symmetry."""
    t = 2.0 * np.pi * np.arange(64) / 64
    x, y = np.meshgrid(t, t)
    h = np.sin(x + 1.3 * np.sin(y)) + 0.6 * np.cos(2 * y - x + 0.4) + 0.3 * np.sin(3 * x + 2 * y)
    h = (h - h.min()) / np.ptp(h)
    return HeightGrid.from_map(0.7 * np.floor(5.0 * h) / 5.0 + 0.3 * h, 0.2)


def _diffuse(albedo: float) -> dict[str, Any]:
    return {"type": "mbtf_surface", "base_color": {"type": "rgb", "value": [albedo] * 3}}


def _estimates(
    shape: HeightGrid,
    bsdf: Mapping[str, Any],
    light: LightKernel | None,
    omega_i: ArrayLike,
    omega_o: ArrayLike,
    *,
    number: int = 0,
    n: int = 64_000,
    u: ArrayLike | None = None,
    sigma: ArrayLike = 4.0,
    spp: int = 16,
    direct: bool = False,
) -> Any:
    """Estimates of M at n queries, with random numbers of their own by `number`. Footprints with σ of four
    tile widths cover the tile evenly: their values are tile means."""
    load_mitsuba()
    from mbtf_gen.render.estimates import Stream
    from mbtf_gen.render.estimator import Estimator
    from mbtf_gen.render.path_tracer import Transport
    from mbtf_gen.render.scene import build_scene

    def rows(x: ArrayLike, trailing: tuple[int, ...]) -> NDArray[np.float32]:
        return np.broadcast_to(np.asarray(x, np.float32), (n, *trailing)).copy()

    u = np.random.default_rng([7, number]).random((n, 2)) if u is None else u
    queries = Queries(rows(u, (2,)), rows(sigma, ()), rows(omega_i, (3,)), rows(omega_o, (3,)))
    estimator = Estimator(build_scene(shape, bsdf), light, Transport(max_depth=1 if direct else 0))
    return estimator.estimate(queries, spp, Stream(17, "test", number))


def _case(found: Any, expected: float) -> Case:
    """Mean of the red channel against its true value; the error follows from the spread over the queries."""
    mean = mean_estimate(0.5 * (found.value_a.astype(np.float64) + found.value_b)[:, 0])
    return Case(mean.value / expected - 1.0, mean.error / abs(expected))


def _towards(cosine: float, azimuth: float) -> F64:
    return from_angles(math.degrees(math.asin(cosine)), azimuth)


def _lambert() -> dict[str, Case]:
    """M = albedo/π for footprints of 0 … 100 tiles, light and view down to cosine 1e-4."""
    out, sigma = {}, np.resize([0.0, 1e-3, 0.5, 100.0], 8000)
    for width, light, view in itertools.product((0.0, 1.0), _GRAZING, _GRAZING):
        to_light, to_view = _towards(light, 20), _towards(view, 200)
        kernel = LightKernel(width)
        options: dict[str, Any] = {"n": 8000, "sigma": sigma, "spp": 32}
        found = _estimates(_PLANE, _diffuse(0.5), kernel, to_light, to_view, **options)
        name = f"light {width:g}°, cosines {light:g} and {view:g}"
        out[name] = _case(found, 0.5 / math.pi)
    return out


def _groove() -> dict[str, Case]:
    """Tile means of a groove agree with the closed form."""
    groove, out = Groove(0.4, 0.7), {}
    bsdf, delta = _diffuse(groove.albedo), LightKernel(0.0)
    for light, view in _PAIRS:
        i, o = from_angles(*light), from_angles(*view)
        found = _estimates(groove.grid, bsdf, delta, i, o, direct=True)
        out[f"light {light}, view {view}"] = _case(found, groove.tile_mean(i, o))
    return out


def _furnace() -> dict[str, Case]:
    """A white surface under constant radiance 1 has radiance 1."""
    out = {}
    for elevation in (90.0, 30.0, 3.0, 0.5):
        view = from_angles(elevation, 40)
        found = _estimates(terraces(), _diffuse(1.0), None, _UP, view, n=4000)
        out[f"view {elevation:g}°"] = _case(found, 1.0)
    return out


def _reciprocity() -> dict[str, Case]:
    """Exchanging light and view leaves the tile mean unchanged, interreflection included."""
    heights, out = terraces(), {}
    for light, view in _PAIRS[1:]:
        one, other = from_angles(*light), from_angles(*view)
        forth, back = (
            _case(_estimates(heights, _diffuse(0.9), LightKernel(0.0), i, o, number=k), 1.0)
            for k, (i, o) in enumerate(((one, other), (other, one)))
        )
        mean = 1.0 + 0.5 * (forth.off + back.off)
        error = math.hypot(forth.error, back.error) / mean
        out[f"{light} and {view}"] = Case((forth.off - back.off) / mean, error)
    return out


def _surface() -> dict[str, Case]:
    """White glossy and metallic planes have albedo 1."""
    out = {}
    for metallic, roughness, cosine in itertools.product(
        (0.0, 1.0), (0.0, 0.1, 0.5, 1.0), (1.0, 0.3, 1e-2, 1e-4)
    ):
        bsdf = {**_diffuse(1.0), "specular": 0.5, "metallic": metallic, "roughness": roughness}
        options: dict[str, Any] = {"n": 4000, "u": [0.5, 0.5], "sigma": 0.1, "spp": 32}
        found = _estimates(_PLANE, bsdf, None, _UP, _towards(cosine, 30), **options)
        out[f"metallic {metallic:g}, roughness {roughness:g}, cosine {cosine:g}"] = _case(found, 1.0)
    return out


def _lost() -> dict[str, Case]:
    """No ray of 300 000 passes through the tile's borders and corners."""
    out, rng = {}, np.random.default_rng(11)
    for aspect in (1.0, 0.5):
        grid, n = HeightGrid(terraces().z, aspect), 150_000
        u = rng.random((n, 2))
        border = np.array([0.0, 0.5 / 64, 1.0 - 0.5 / 64, 1.0 - 1e-7])
        third = n // 3
        u[:third, 0] = rng.choice(border, third)
        u[third : 2 * third] = rng.choice(border, (third, 2))
        z = np.exp(rng.uniform(math.log(0.02), 0.0, n))
        phi = 2.0 * np.pi * rng.random(n)
        # Rays along the axes of the grid run inside edges.
        phi[::2] = np.round(phi[::2] / (0.5 * np.pi)) * 0.5 * np.pi
        r = np.sqrt(1.0 - z * z)
        view = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)
        options: dict[str, Any] = {"n": n, "u": u, "sigma": 0.0, "spp": 2, "direct": True}
        e = _estimates(grid, _diffuse(0.0), LightKernel(0.0), _UP, view, **options)
        out[f"aspect {aspect:g}"] = Case(float(e.lost + e.capped))
    return out
