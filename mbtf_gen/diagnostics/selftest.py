"""Self-test of the physics on the user's machine: ``mbtf-gen selftest``.

Every check measures quantities whose true values are known, on the generator's own estimator. It passes if
the error of each case is at most its tolerance plus 4.5 standard errors. Checks repeat with new random
numbers until the time is up; that reduces the standard errors.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.data.schema import Queries
from mbtf_core.directions import from_angles
from mbtf_core.errors import EXIT_BAD_INPUT, EXIT_OK, EngineError, MbtfError, reason
from mbtf_core.stats import Estimate, mean_estimate
from mbtf_gen.diagnostics.closed_forms import Groove
from mbtf_gen.engine.runtime import CPU_VARIANT, CUDA_VARIANT, load_mitsuba, prove
from mbtf_gen.sampling.light_kernel import LightKernel
from mbtf_gen.tile.fiber_tile import FiberTile
from mbtf_gen.tile.fibers.curves import Curve
from mbtf_gen.tile.heights.grid import HeightGrid

F64 = NDArray[np.float64]

# Exceeded by one normal error in 150 000: with a hundred cases, one false alarm in 1500 runs.
STANDARD_ERRORS = 4.5

_UP = from_angles(90.0, 0.0)
_PLANE = HeightGrid(np.zeros((4, 4)), 1.0)
_PAIRS = [((70, 0), (80, 0)), ((35, 10), (50, 200)), ((20, 180), (60, 30)), ((15, 60), (25, 75))]
_GRAZING = (1.0, 0.1, 1e-2, 1e-4)


@dataclass(frozen=True)
class Case:
    """One measurement.

    Attributes
    ----------
    off : measured minus true value, relative to it, or a count
    error : its standard error; 0 for deterministic cases
    """

    off: float
    error: float = 0.0


Cases = Mapping[str, Case]


@dataclass
class Check:
    """A property with a known answer, and what was measured of it.

    Attributes
    ----------
    name, statement : in a few words, and in a sentence
    tolerance : error that a case may have, beside its statistical error
    measure : cases by name of one round; each round, numbered from 0, has its own random numbers. None means
        that the part under test is absent
    required : a failure fails the self-test
    cases, rounds, seconds : mean over the rounds by name, their number and time
    fault : why the check could not run; empty if it did
    """

    name: str
    statement: str
    tolerance: float
    measure: Callable[[int], Cases | None]
    required: bool = True
    cases: dict[str, Case] = field(default_factory=dict)
    rounds: int = 0
    seconds: float = 0.0
    fault: str = ""

    @property
    def worst(self) -> tuple[str, Case] | None:
        """Name and measurement of the case closest to its limit."""
        found = self.cases.items()
        return max(found, key=lambda item: abs(item[1].off) / self._limit(item[1])) if found else None

    def _limit(self, case: Case) -> float:
        return max(self.tolerance + STANDARD_ERRORS * case.error, 1e-300)

    @property
    def state(self) -> Literal["ok", "failed", "absent"]:
        """``absent``: this machine lacks the part under test."""
        if self.fault or not self.cases:
            return "failed" if self.fault else "absent"
        good = all(math.isfinite(c.error) and abs(c.off) <= self._limit(c) for c in self.cases.values())
        return "ok" if good else "failed"

    def run_round(self) -> None:
        """Measure once more, and include the round in the means."""
        start = time.monotonic()
        try:
            found = self.measure(self.rounds)
        except MbtfError as error:
            self.fault = error.what
        except Exception as error:  # whatever goes wrong is a finding
            self.fault = reason(error)
        else:
            n = self.rounds
            for name, new in (found or {}).items():
                old = self.cases.get(name, Case(0.0))
                mean = (n * old.off + new.off) / (n + 1)
                self.cases[name] = Case(mean, math.hypot(n * old.error, new.error) / (n + 1))
            self.rounds += 1
        self.seconds += time.monotonic() - start

    def as_dict(self) -> dict[str, Any]:
        """Plain data for ``--json``."""
        name, worst = self.worst or (None, None)
        stated = ("name", "statement", "required", "tolerance", "state", "rounds", "seconds", "fault")
        found = {"worst_case": name, "worst": worst and worst.off, "error": worst and worst.error}
        return {**{key: getattr(self, key) for key in stated}, **found, "cases": len(self.cases)}


def run_checks(
    checks: Sequence[Check], seconds: float, progress: Callable[[float, str], None] | None = None
) -> None:
    """Run every check once, then repeat those with statistical errors until `seconds` have passed.

    Parameters
    ----------
    checks : sequence of Check
        Checks to run; they hold the results.
    seconds : float
        Time to use; every check runs at least once.
    progress : callable, optional
        Called before each round with (seconds passed, name of the check).
    """
    start = time.monotonic()
    waiting = list(checks)
    while waiting or time.monotonic() - start < seconds:
        noisy = [c for c in checks if not c.fault and any(case.error for case in c.cases.values())]
        if not waiting and not noisy:
            return
        # Of those that ran, the check with the least time so far, so that all get the same.
        check = waiting.pop(0) if waiting else min(noisy, key=lambda c: c.seconds)
        if progress is not None:
            progress(time.monotonic() - start, check.name)
        check.run_round()


def exit_code(checks: Sequence[Check]) -> int:
    """0, or 3 when a required check failed."""
    return EXIT_BAD_INPUT if any(c.required and c.state == "failed" for c in checks) else EXIT_OK


def as_text(checks: Sequence[Check]) -> str:
    """A table for a terminal, the worst case of each failed check, and the result."""
    rows = [("check", "worst error", "± statistical", "tolerance", "cases", "")]
    notes = []
    for check in checks:
        error = random = "-"
        if check.worst is not None:
            name, case = check.worst
            error, random = f"{abs(case.off):.1e}", f"{case.error:.1e}" if case.error else "exact"
        rows.append((check.name, error, random, f"{check.tolerance:.1e}", str(len(check.cases)), check.state))
        if check.state == "failed":
            notes.append(f"{check.name}: {check.fault or f'{name}: off by {error} ± {random}'}")
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
    failed = [check.name for check in checks if check.state == "failed"]
    return "\n".join([*lines, *notes, f"failed: {', '.join(failed)}" if failed else "every check passed"])


def as_json(checks: Sequence[Check]) -> dict[str, Any]:
    """Plain data for ``--json``."""
    return {"ok": exit_code(checks) == EXIT_OK, "checks": [check.as_dict() for check in checks]}


def all_checks() -> list[Check]:
    """Every check, in the order in which they are reported."""
    return [
        Check(
            "Lambert plane",
            "M = albedo/π for footprints of 0 … 100 tiles, light and view down to cosine 1e-4",
            1e-4,
            _lambert,
        ),
        Check("V-groove", "tile means of a groove agree with the closed form", 1e-3, _groove),
        Check("furnace", "a white surface under constant radiance 1 has radiance 1", 2e-4, _furnace),
        Check(
            "fibers",
            "what white fibers return of constant radiance 1 and what passes between them add up to 1",
            2e-4,
            _fibers,
        ),
        Check(
            "reciprocity",
            "exchanging light and view leaves the tile mean unchanged, interreflection included",
            2e-3,
            _reciprocity,
        ),
        Check("surface energy", "white glossy and metallic planes have albedo 1", 2e-3, _surface),
        Check("periodicity", "no ray passes through the tile's borders and corners", 0.0, _lost),
        Check(
            "CUDA",
            "tile means of the groove on the GPU agree with the closed form",
            1e-3,
            _cuda,
            required=False,
        ),
    ]


def terraces(cells: int = 64) -> HeightGrid:
    """A periodic height field with terraces, steep flanks and no symmetry."""
    t = 2.0 * np.pi * np.arange(cells) / cells
    x, y = np.meshgrid(t, t)
    h = np.sin(x + 1.3 * np.sin(y)) + 0.6 * np.cos(2 * y - x + 0.4) + 0.3 * np.sin(3 * x + 2 * y)
    h = (h - h.min()) / np.ptp(h)
    return HeightGrid.from_map(0.7 * np.floor(5.0 * h) / 5.0 + 0.3 * h, 0.2)


def _diffuse(albedo: float) -> dict[str, Any]:
    return {"type": "mbtf_surface", "base_color": {"type": "rgb", "value": [albedo] * 3}}


def _estimates(
    shape: HeightGrid | FiberTile,
    bsdf: Mapping[str, Any],
    light: LightKernel | None,
    omega_i: ArrayLike,
    omega_o: ArrayLike,
    round_number: int,
    *,
    n: int = 16_000,
    u: ArrayLike | None = None,
    sigma: ArrayLike = 4.0,
    spp: int = 16,
    direct: bool = False,
    variant: str = CPU_VARIANT,
) -> Any:
    """Estimates of M at n queries; each round has its own random numbers. Footprints with σ of four tile
    widths cover the tile evenly: their values are tile means."""
    load_mitsuba(variant)
    from mbtf_gen.render.estimates import Stream
    from mbtf_gen.render.estimator import Estimator
    from mbtf_gen.render.path_tracer import Transport
    from mbtf_gen.render.scene import build_scene

    def rows(x: ArrayLike, trailing: tuple[int, ...]) -> NDArray[np.float32]:
        return np.broadcast_to(np.asarray(x, np.float32), (n, *trailing)).copy()

    u = np.random.default_rng([7, round_number]).random((n, 2)) if u is None else u
    queries = Queries(rows(u, (2,)), rows(sigma, ()), rows(omega_i, (3,)), rows(omega_o, (3,)))
    estimator = Estimator(build_scene(shape, bsdf), light, Transport(max_depth=1 if direct else 0))
    return estimator.estimate(queries, spp, Stream(17, "test", round_number))


def _mean(found: Any) -> Estimate:
    """Mean of the red channel, and its error from the spread over the queries."""
    return mean_estimate(0.5 * (found.value_a.astype(np.float64) + found.value_b)[:, 0])


def _off(measured: Estimate, expected: float) -> Case:
    return Case(measured.value / expected - 1.0, measured.error / abs(expected))


def _towards(cosine: float, azimuth: float) -> F64:
    return from_angles(math.degrees(math.asin(cosine)), azimuth)


def _lambert(round_number: int) -> Cases:
    out, sigma = {}, np.resize([0.0, 1e-3, 0.5, 100.0], 2000)
    for width, light, view in itertools.product((0.0, 1.0), _GRAZING, _GRAZING):
        to_light, to_view = _towards(light, 20), _towards(view, 200)
        kernel = LightKernel(width)
        options: dict[str, Any] = {"n": 2000, "sigma": sigma, "spp": 32}
        found = _estimates(_PLANE, _diffuse(0.5), kernel, to_light, to_view, round_number, **options)
        name = f"light {width:g}°, cosines {light:g} and {view:g}"
        out[name] = _off(_mean(found), 0.5 / math.pi)
    return out


def _groove(round_number: int, variant: str = CPU_VARIANT) -> Cases:
    groove, out = Groove(0.4, 0.7), {}
    bsdf, delta = _diffuse(groove.albedo), LightKernel(0.0)
    for light, view in _PAIRS:
        i, o = from_angles(*light), from_angles(*view)
        found = _estimates(groove.grid, bsdf, delta, i, o, round_number, direct=True, variant=variant)
        out[f"light {light}, view {view}"] = _off(_mean(found), groove.tile_mean(i, o))
    return out


def _furnace(round_number: int) -> Cases:
    out = {}
    for elevation in (90.0, 30.0, 3.0, 0.5):
        view = from_angles(elevation, 40)
        found = _estimates(terraces(), _diffuse(1.0), None, _UP, view, round_number, n=4000)
        out[f"view {elevation:g}°"] = _off(_mean(found), 1.0)
    return out


def _fibers(round_number: int) -> Cases:
    load_mitsuba()
    rng, s, out = np.random.default_rng(5), np.arange(8) / 8, {}
    curves = []
    for k in range(40):
        wave = 2.0 * np.pi * (s + rng.random())
        across, down = rng.random() + 0.05 * np.sin(wave), 0.02 * np.cos(wave) - 0.2 * rng.random()
        points = np.column_stack([s, across, down] if k % 2 else [across, s, down])
        curves.append(Curve.through(points, 0.01, np.eye(3)[1 - k % 2]))
    felt = FiberTile.settled(1.0, curves, np.zeros(len(curves), int), np.ones((1, 3)))
    for elevation in (90.0, 20.0, 3.0):
        view = from_angles(elevation, 40)
        e = _estimates(felt, felt.surface(), None, _UP, view, round_number, n=1000)
        total = 0.5 * (e.value_a.astype(np.float64) + e.value_b)[:, 0] + e.transmittance
        out[f"view {elevation:g}°"] = _off(mean_estimate(total), 1.0)
    return out


def _reciprocity(round_number: int) -> Cases:
    heights, out = terraces(), {}
    for light, view in _PAIRS[1:]:
        one, other = from_angles(*light), from_angles(*view)
        forth, back = (
            _mean(_estimates(heights, _diffuse(0.9), LightKernel(0.0), i, o, 2 * round_number + k))
            for k, (i, o) in enumerate(((one, other), (other, one)))
        )
        mean = 0.5 * (forth.value + back.value)
        error = math.hypot(forth.error, back.error) / mean
        out[f"{light} and {view}"] = Case((forth.value - back.value) / mean, error)
    return out


def _surface(round_number: int) -> Cases:
    out = {}
    for metallic, roughness, cosine in itertools.product(
        (0.0, 1.0), (0.0, 0.1, 0.5, 1.0), (1.0, 0.3, 1e-2, 1e-4)
    ):
        bsdf = {**_diffuse(1.0), "specular": 0.5, "metallic": metallic, "roughness": roughness}
        options: dict[str, Any] = {"n": 1000, "u": [0.5, 0.5], "sigma": 0.1, "spp": 32}
        found = _estimates(_PLANE, bsdf, None, _UP, _towards(cosine, 30), round_number, **options)
        out[f"metallic {metallic:g}, roughness {roughness:g}, cosine {cosine:g}"] = _off(_mean(found), 1.0)
    return out


def _lost(round_number: int) -> Cases:
    """Number of rays from above that hit no surface, of 300 000."""
    out, rng = {}, np.random.default_rng([11, round_number])
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
        e = _estimates(grid, _diffuse(0.0), LightKernel(0.0), _UP, view, round_number, **options)
        out[f"aspect {aspect:g}"] = Case(float(e.lost + e.capped))
    return out


def _cuda(round_number: int) -> Cases | None:
    """In a child process, because a driver may abort it. None without a device."""
    from mbtf_core.run.processes import run_child

    if prove(CUDA_VARIANT).fault:
        return None
    outcome = run_child(__name__, "groove_on_cuda", str(round_number), timeout=180.0)
    if outcome.fault:
        raise EngineError(outcome.fault)
    return {name: Case(*numbers) for name, numbers in outcome.answers.items()}


def groove_on_cuda(round_number: str) -> Iterator[dict[str, Any]]:
    """Child process of the CUDA check."""
    yield {name: (c.off, c.error) for name, c in _groove(int(round_number), CUDA_VARIANT).items()}
