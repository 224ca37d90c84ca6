"""Decides the effects plan: looks at heights and maps, and at a small pilot where theory gives no bound."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .effects import EFFECTS, OF_RELIEF, Effect, EffectsPlan, Wish
from .errors import UsageError
from .light import LightKernel
from .maps import resample
from .pilot import Pilot, pilot_queries
from .relief_costs import POINTS, ReliefCosts, largest_slope, relief_costs

if TYPE_CHECKING:
    from .generation import Job

# Standard deviations of the light lobe beyond which nothing of it is looked for, and the share of a Gaussian
# that lies beyond them on one side.
LOBE_TAIL = 3.5
LOBE_TAIL_SHARE = 2.4e-4
# A ray may leave the tile sideways by this share of its shorter side before it needs the neighbours.
LONGEST_REACH = 0.45
# Light found by next-event estimation alone keeps its variance when the narrowest lobe of the surface, about
# 2α wide, is so many times wider than the light's.
WIDER = 4.0
# Runs of fewer paths are done before a pilot has paid for itself.
SMALL_RUN = 2_000_000
# Deepest cap on surface interactions that is tried.
DEEPEST_CAP = 4


@dataclass(frozen=True)
class _Look:
    """What the decisions are made from."""

    job: Job
    albedo: NDArray[np.float64]
    lambert: bool
    own_bsdf: bool
    pilots: bool

    @cached_property
    def steepest(self) -> float:
        """Largest slope of the mesh."""
        return largest_slope(self.job.grid)

    @property
    def lowest_light(self) -> float:
        """Elevation in radians below which the light is not looked for; ≤ 0 where there is no such bound."""
        config = self.job.config
        return float(np.arcsin(config.queries.min_cos) - LOBE_TAIL * np.radians(config.light.width))

    @property
    def below_lowest(self) -> float:
        """Share of the light below it, at most."""
        return LOBE_TAIL_SHARE if self.job.config.light.width > 0 else 0.0


def plan_effects(job: Job, *, pilots: bool = True) -> EffectsPlan:
    """Effects plan of a run.

    Parameters
    ----------
    pilots : measure where theory gives no bound; otherwise such effects stay on

    Raises
    ------
    UsageError : an effect was asked for that the material does not have, or that needs one asked away
    """
    wish = Wish.parse(job.config.effects.mode)
    look = _look(job, pilots)
    tolerance = job.config.effects.tolerance
    costs = _relief(look)
    of_surface = [*_surface(look), _normal(look, costs), _opacity(look), _fibres()]
    decided = {e.name: wish.decide(e) for e in _affordable(of_surface, tolerance)}
    left = tolerance - sum(e.cost or 0.0 for e in decided.values() if not e.on)
    plan = _of_relief(look, wish, decided, costs, left)
    if wish.base != "all" and _known_exactly(look, plan):
        plan = replace(plan, closed_form=True)
    return replace(plan, mode=job.config.effects.mode, tolerance=tolerance)


def simulated(job: Job) -> EffectsPlan:
    """Everything that the material calls for, without looking at costs: the plan of reference pictures."""
    wish = Wish.parse(job.config.effects.mode)
    look = _look(job, False)
    flat = job.grid.relief == 0.0
    effects = [*_surface(look), _normal(look, None), _opacity(look), _fibres()]
    effects += [Effect(name, not flat, "flat" if flat else "a relief") for name in OF_RELIEF]
    effects.append(Effect("mis", True, "reference"))
    decided = _consistent({e.name: wish.decide(e) for e in effects}, wish)
    plan = _assemble(job, decided, job.config.transport.max_depth)
    return replace(plan, mode=job.config.effects.mode)


def _look(job: Job, pilots: bool) -> _Look:
    material = job.material
    base = np.asarray(material.basecolor, np.float64)
    own = material.bsdf is not None
    albedo = np.ones((1, 1, 3)) if own else base.reshape(*(base.shape[:-1] or (1, 1)), 3)
    return _Look(
        job,
        albedo,
        material.is_lambert and material.coat is None,
        own,
        pilots,
    )


def _relief(look: _Look) -> ReliefCosts | None:
    """Costs of the relief's effects for a Lambert surface; None on a plane."""
    job = look.job
    if job.grid.relief == 0.0 or not look.albedo.any() or not look.pilots:
        return None
    residual = job.residual[0] if job.residual is not None else None
    kernel = LightKernel(job.config.light.width)
    queries = pilot_queries(job, POINTS)
    omega_i, omega_o = queries.omega_i.astype(np.float64), queries.omega_o.astype(np.float64)
    return relief_costs(job.grid, omega_i, omega_o, kernel, look.albedo, residual)


def _affordable(effects: list[Effect], tolerance: float) -> list[Effect]:
    """Effects that are on are switched off, the cheapest first, as long as their costs fit the tolerance."""
    out = {e.name: e for e in effects}
    for e in sorted((e for e in effects if e.on and e.cost is not None), key=lambda e: e.cost or 0.0):
        cost = e.cost or 0.0
        if cost > tolerance:
            break
        out[e.name] = replace(e, on=False)
        tolerance -= cost
    return list(out.values())


def _surface(look: _Look) -> list[Effect]:
    """Specular lobe, metal, coat."""
    material = look.job.material
    if look.own_bsdf:
        reason = f"the material's own BSDF '{(material.bsdf or {})['type']}', not analysed"
        on = Effect("specular", True, reason, present=False)
        return [on, *(Effect(n, False, reason, 0.0, "exact", False) for n in ("metallic", "coat"))]
    metal = 0.0 if material.metallic is None else float(np.max(material.metallic))
    specular = 0.0 if material.specular is None else float(np.max(material.specular))
    out = []
    if look.lambert:
        reason = "Lambert: no roughness, metallic or specular is given"
        out.append(Effect("specular", False, reason, 0.0, "exact", False))
    elif specular == 0.0:
        out.append(Effect("specular", False, "specular is 0 everywhere", 0.0, "exact", False))
    else:
        out.append(Effect("specular", True, f"specular up to {specular:.3g}"))
    out.append(
        Effect("metallic", True, f"metallic up to {metal:.3g}")
        if metal > 0
        else Effect("metallic", False, "no metal anywhere", 0.0, "exact", False)
    )
    coat = 0.0 if material.coat is None else float(np.max(material.coat))
    out.append(
        Effect("coat", True, f"coat up to {coat:.3g}")
        if coat > 0
        else Effect("coat", False, "none is given", 0.0, "exact", False)
    )
    return out


def _normal(look: _Look, costs: ReliefCosts | None) -> Effect:
    job = look.job
    if job.residual is None:
        reason = "no map" if job.material.normal is None else "off in the configuration"
        if look.own_bsdf:
            reason = "the material has a BSDF of its own"
        return Effect("normal", False, reason, 0.0, "exact", False)
    slopes, share = job.residual
    rms = float(np.sqrt(np.mean(np.sum(slopes**2, axis=-1))))
    reason = f"residual slopes of {np.degrees(np.arctan(rms)):.2g} degrees (RMS)"
    if job.config.effects.normal == "residual" and job.grid.relief > 0:
        reason += f"; the map repeats {share:.2g} of the relief's slopes"
    if rms == 0.0:
        return Effect("normal", False, reason, 0.0, "exact")
    # The estimate shades Lambert; lobes are steeper functions of the normal.
    known = costs is not None and look.lambert
    return Effect("normal", True, reason, costs.normal if costs and known else None, "pilot")


def _opacity(look: _Look) -> Effect:
    opacity = look.job.material.opacity
    if opacity is None or look.own_bsdf:
        return Effect("opacity", False, "no map" if opacity is None else "own BSDF", 0.0, "exact", False)
    through = 1.0 - np.asarray(opacity, np.float64)
    if not through.any():
        return Effect("opacity", False, "opaque everywhere", 0.0, "exact", False)
    rows, columns = (
        max(a, b) for a, b in zip(np.shape(opacity) or (1, 1), look.albedo.shape[:2], strict=True)
    )
    through = np.asarray(resample(np.atleast_2d(through), rows, columns), np.float64)[..., None]
    colour = np.asarray(resample(look.albedo, rows, columns), np.float64)
    mean = float(np.mean((1.0 - through) * colour))
    # Twice the share of the light that holes take: neighbouring facets may be lit that much more strongly.
    lost = 2.0 * float(np.sqrt(np.mean((through * colour) ** 2)))
    cost = lost / mean if mean > 0 and look.lambert else None
    return Effect("opacity", True, f"{through.mean():.1%} of the area lets light through", cost, "pilot")


def _fibres() -> Effect:
    return Effect("fibres", False, "a height field, no fibres", 0.0, "exact", False)


def _of_relief(
    look: _Look, wish: Wish, decided: dict[str, Effect], costs: ReliefCosts | None, left: float
) -> EffectsPlan:
    """Effects of the relief and the sampling of light, given the surface's."""
    job = look.job
    cap = job.config.transport.max_depth
    decided["mis"] = wish.decide(_mis(look))
    black = not look.albedo.any() and look.lambert and not (decided["coat"].on or decided["opacity"].on)
    if job.grid.relief == 0.0 or black:
        reason = "flat" if job.grid.relief == 0.0 else "black: nothing is reflected"
        for name in OF_RELIEF:
            decided[name] = wish.decide(Effect(name, False, reason, 0.0, "exact"))
        return _assemble(job, _consistent(decided, wish), cap)
    shadowing = _shadowing(look, costs)
    masking = Effect(
        "masking",
        True,
        f"relief of {job.grid.relief:.4g} tile widths",
        costs.masking if costs else None,
        "pilot",
    )
    bounces = _bounce_bound(look)
    if costs is not None and look.lambert and costs.masking + bounces <= left:
        # Without the displaced tile its other effects go too; their costs are in the sum.
        masking = replace(masking, on=False, cost=costs.masking + bounces)
        for name in OF_RELIEF[1:]:
            decided[name] = wish.decide(Effect(name, False, "no displaced tile", 0.0, "pilot"))
        decided["masking"] = wish.decide(masking)
        return _assemble(job, _consistent(decided, wish), cap)
    decided["masking"] = wish.decide(masking)
    # The estimate shades Lambert: for lobes only the bound counts.
    sure = look.lambert or shadowing.known == "bound"
    if sure and shadowing.cost is not None and shadowing.cost <= left / 2:
        left -= shadowing.cost
        shadowing = replace(shadowing, on=False)
    decided["shadowing"] = wish.decide(shadowing)
    decided["neighbours"] = Effect("neighbours", True, "rays re-enter the tile")
    decided["interreflection"] = Effect("interreflection", True, "not looked at")
    decided["interreflection"], cap, cost = _interreflection(look, wish, decided, left)
    bounces_left_out = 0.0 if decided["interreflection"].on else decided["interreflection"].cost or 0.0
    left -= cost + bounces_left_out
    decided["neighbours"] = wish.decide(_neighbours(look, decided, left))
    return _assemble(job, _consistent(decided, wish), cap, cost)


def _shadowing(look: _Look, costs: ReliefCosts | None) -> Effect:
    angle = np.degrees(np.arctan(look.steepest))
    lowest = look.lowest_light
    if lowest > 0 and look.steepest <= np.tan(lowest):
        reason = (
            f"no slope exceeds {angle:.2g} degrees, the light stays above {np.degrees(lowest):.2g} degrees"
        )
        return Effect("shadowing", True, reason, look.below_lowest, "bound")
    reason = f"slopes up to {angle:.0f} degrees, light down to {np.degrees(max(lowest, 0.0)):.2g} degrees"
    return Effect("shadowing", True, reason, costs.shadowing if costs else None, "pilot")


def _mis(look: _Look) -> Effect:
    """Whether sampling the surface finds light that next-event estimation finds only with high variance."""
    job = look.job
    width = np.radians(job.config.light.width)
    if width == 0.0:
        return Effect("mis", False, "a delta light cannot be hit", 0.0, "exact")
    if look.own_bsdf:
        return Effect("mis", True, "the material's own BSDF, not analysed")
    if look.lambert:
        if job.config.light.width <= 20.0:
            reason = f"Lambert under a light of {job.config.light.width:g} degrees: no bias, no more variance"
            return Effect("mis", False, reason, 0.0, "exact")
        return Effect("mis", True, "a wide light")
    smoothest = 1.0 if job.material.is_lambert else float(np.min(np.asarray(job.material.roughness)))
    if job.material.coat is not None:
        smoothest = min(smoothest, float(np.min(np.asarray(job.material.coat_roughness))))
    lobe = 2.0 * smoothest**2
    text = f"narrowest lobe {np.degrees(lobe):.2g} degrees, light {job.config.light.width:g}"
    if lobe >= WIDER * width:
        return Effect("mis", False, f"{text}: no bias, hardly more variance", 0.0, "exact")
    return Effect("mis", True, text)


def _bounce_bound(look: _Look) -> float:
    """Interreflection over direct light on a gentle relief: facets of slope s see others only within
    2·atan(s) of their planes, a share sin² of their cosine-weighted view, and these are lit at most by
    1/cos."""
    share = np.sin(min(2.0 * np.arctan(look.steepest), 0.5 * np.pi)) ** 2
    brightest = 1.0 / look.job.config.queries.min_cos
    return float(look.albedo.max() * share * brightest)


def _interreflection(
    look: _Look, wish: Wish, decided: dict[str, Effect], left: float
) -> tuple[Effect, int, float]:
    """Interreflection, its cap and the cap's cost, by a pilot with and without them on the same random
    numbers."""
    asked = look.job.config.transport.max_depth
    effect = decided["interreflection"]
    if asked == 1:
        return wish.decide(Effect("interreflection", False, "max_depth 1", None)), 1, 0.0
    if "interreflection" in wish.forced or wish.base != "auto" or not decided["masking"].on:
        effect = wish.decide(replace(effect, reason="a relief"))
        return effect, asked, 0.0
    if not look.pilots:
        return replace(effect, reason="a relief; the run is too small for a pilot"), asked, 0.0
    pilot = Pilot(look.job, _assemble(look.job, _consistent(dict(decided), wish), asked))
    cost, upper = pilot.cost_of_limit(1)
    reason = "light from facet to facet"
    if upper <= left:
        return Effect("interreflection", False, reason, upper, "pilot"), 1, 0.0
    found = Effect("interreflection", True, reason, cost, "pilot")
    if asked:
        return found, asked, 0.0
    # Every further interaction keeps no more than the brightest reflectance of the light.
    brightest = float(look.albedo.max())
    for cap in range(2, DEEPEST_CAP + 1):
        if cost * brightest ** (cap - 1) > 2.0 * left:
            continue
        _, upper = pilot.cost_of_limit(cap)
        if upper <= left:
            reason += f"; at most {cap} interactions, cutting the rest costs below {upper:.1g}"
            return replace(found, reason=reason), cap, upper
    return replace(found, reason=reason + "; no depth limit, Russian roulette"), 0, 0.0


def _neighbours(look: _Look, decided: dict[str, Effect], left: float) -> Effect:
    job = look.job
    if decided["interreflection"].on or decided["mis"].on:
        return Effect("neighbours", True, "scattered rays go anywhere")
    reach = reach_of(job)
    limit = LONGEST_REACH * min(1.0, job.grid.aspect)
    if reach <= limit and look.below_lowest <= left:
        reason = f"rays move sideways by at most {reach:.2g} tile widths"
        return Effect("neighbours", False, reason, look.below_lowest, "bound")
    reason = f"rays cross up to {reach:.3g} tile widths" if np.isfinite(reach) else "light from the horizon"
    return Effect("neighbours", True, reason)


def reach_of(job: Job) -> float:
    """How far, in tile widths, view rays and light rays move sideways within the relief."""
    view = float(np.arcsin(job.config.queries.min_cos))
    lowest = min(view, view - LOBE_TAIL * float(np.radians(job.config.light.width)))
    return float(job.grid.relief / np.tan(lowest)) if lowest > 0 else float("inf")


def _consistent(decided: dict[str, Effect], wish: Wish) -> dict[str, Effect]:
    """What depends on an effect goes with it."""

    def off(name: str, because: str) -> None:
        if decided[name].on:
            if wish.forced.get(name):
                raise UsageError(f"'{EFFECTS[name]}' needs '{because}'", where=f"--effects +{name}")
            decided[name] = replace(decided[name], on=False, reason=f"needs {because}")

    if not decided["masking"].on:
        for name in OF_RELIEF[1:]:
            off(name, EFFECTS["masking"])
    elif not decided["neighbours"].on:
        off("interreflection", EFFECTS["neighbours"])
        off("mis", EFFECTS["neighbours"])
    return decided


def without(plan: EffectsPlan, name: str) -> EffectsPlan:
    """The plan without an effect and without what needs it."""
    wish = Wish("auto", {name: False})
    decided = _consistent({e.name: wish.decide(e) for e in plan.effects}, wish)
    return replace(plan, effects=tuple(decided.values()))


def _assemble(job: Job, decided: dict[str, Effect], cap: int, cost: float = 0.0) -> EffectsPlan:
    effects = tuple(decided[name] for name in EFFECTS)
    return EffectsPlan(effects, cap, cost, job.config.transport.roulette_depth)


def _known_exactly(look: _Look, plan: EffectsPlan) -> bool:
    """A plane of one Lambert colour, or black: M follows without tracing."""
    if any(plan.on(n) for n in ("specular", "metallic", "coat", "opacity")) or look.own_bsdf:
        return False
    base = np.asarray(look.job.material.basecolor)
    if not base.any():
        return True
    one = bool(np.all(base == base.reshape(-1, 3)[0]))
    return one and look.job.grid.relief == 0.0 and not plan.on("masking") and not plan.on("normal")
