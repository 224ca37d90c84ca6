"""Decides the effects plan from heights and maps, and by a pilot where theory gives no bound."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mbtf_gen.config.effects_request import DISPLACEMENT_EFFECTS, EFFECTS, EffectsRequest
from mbtf_gen.job import Job
from mbtf_gen.planning.bounds import POINTS, DisplacementBounds, displacement_bounds
from mbtf_gen.planning.effects import Effect, EffectsPlan, consistent, decide, without
from mbtf_gen.planning.pilot import Pilot, pilot_queries
from mbtf_gen.planning.surface_effects import (
    Analysis,
    analyze,
    bsdf_sampling,
    normal_map,
    opacity,
    passing,
    transmission,
)
from mbtf_gen.sampling.light_kernel import LightKernel

# The light lobe is cut at this many standard deviations; the second number is the tail of a Gaussian there.
LOBE_TAIL = 3.5
LOBE_TAIL_SHARE = 2.4e-4
# Deepest cap on surface interactions that is tried.
DEEPEST_CAP = 4
# A specular lobe, clearcoat or sheen below this strength may be negligible: a pilot measures it.
FAINT = 0.05
# Layers that may be faint, with the factor from their values to their strength. A specular of 1/4 (F0 = 2 %)
# is the smallest that reflects everything at grazing angles.
LAYERS = {"specular": 4.0, "metallic": math.inf, "clearcoat": 1.0, "sheen": 1.0}
# Safety factor on the bias of a faint layer, which we scale down from that of a full one. Scaling is exact
# except for light that meets the layer more than once.
FAINT_CAUTION = 2.0


def plan_effects(job: Job, *, pilots: bool = True) -> EffectsPlan:
    """Decide which effects a run simulates.

    Parameters
    ----------
    job : Job
        Configuration and material.
    pilots : bool
        Whether pilots measure where theory gives no bound. Otherwise such effects stay on.

    Returns
    -------
    EffectsPlan

    Raises
    ------
    UsageError
        The user requests an effect that the material lacks, or that needs one switched off.
    """
    request = EffectsRequest.parse(job.config.effects.mode)
    scene = analyze(job, pilots)
    tolerance = job.config.effects.tolerance
    reflecting = _surface(scene, [n for n in LAYERS if request.base == "auto" and n not in request.forced])
    decided = {e.name: decide(request, e) for e in _affordable(reflecting, tolerance)}
    left = tolerance - sum(e.bias_bound or 0.0 for e in decided.values() if not e.on)
    if not any(e.on for e in decided.values()):
        scene = replace(scene, lambert=True)
    bounds = _displacement_bounds(scene)
    others = _affordable([normal_map(scene, bounds), opacity(scene, bounds)], left)
    decided |= {e.name: decide(request, e) for e in others}
    left = tolerance - sum(e.bias_bound or 0.0 for e in decided.values() if not e.on)
    plan = _displacement_plan(scene, request, decided, bounds, left)
    if request.base != "all" and _has_closed_form(scene, plan):
        plan = replace(plan, closed_form=True)
    return replace(plan, mode=job.config.effects.mode, tolerance=tolerance)


def reference_plan(job: Job) -> EffectsPlan:
    """The plan of reference pictures: all effects that the material has, whatever their size."""
    request = EffectsRequest.parse(job.config.effects.mode)
    scene = analyze(job, False)
    effects = [*_surface(scene), transmission(scene), normal_map(scene, None), opacity(scene, None)]
    explanation = "flat" if scene.flat else scene.kind
    effects += [Effect(name, not scene.flat, explanation) for name in DISPLACEMENT_EFFECTS]
    effects.append(Effect("bsdf_sampling", True, "reference"))
    decided = consistent({e.name: decide(request, e) for e in effects}, request)
    plan = _assemble(job, decided, job.config.transport.max_depth)
    return replace(plan, mode=job.config.effects.mode)


def _displacement_bounds(scene: Analysis) -> DisplacementBounds | None:
    """Bias bounds of displacement and normal map; None unless they apply, to a Lambert surface that is not
    black."""
    job, mapped = scene.job, scene.mapped
    if (scene.flat and mapped is None) or not (scene.lambert and scene.albedo.any() and scene.pilots):
        return None
    queries = pilot_queries(job, POINTS)
    return displacement_bounds(
        job.grid,
        queries.omega_i.astype(np.float64),
        queries.omega_o.astype(np.float64),
        LightKernel(job.config.light.width),
        scene.albedo,
        None if mapped is None else mapped[0],
        passing(scene),
    )


def _affordable(effects: list[Effect], tolerance: float) -> list[Effect]:
    """Switch effects off in the order of their bias bounds, while the sum is within the tolerance."""
    out = {e.name: e for e in effects}
    bounded = [(e.bias_bound, e.name) for e in effects if e.on and e.bias_bound is not None]
    for bound, name in sorted(bounded, key=lambda one: one[0]):
        if bound > tolerance:
            break
        out[name] = replace(out[name], on=False)
        tolerance -= bound
    return list(out.values())


def _surface(scene: Analysis, measured: Sequence[str] = ()) -> list[Effect]:
    """Specular lobe, metal, clearcoat, sheen; those in `measured` are measured where they are faint."""
    material = scene.job.material
    if scene.own_bsdf:
        text = f"the material's own BSDF '{(material.bsdf or {})['type']}', not analyzed"
        on = Effect("specular", True, text, present=False)
        others = ("metallic", "clearcoat", "sheen")
        return [on, *(Effect(n, False, text, 0.0, present=False) for n in others)]
    no_specular = "specular is 0 everywhere"
    if material.specular is None:
        no_specular = "Lambert: no roughness, metallic or specular"
    tint = 1.0 if material.sheen_color is None else float(np.max(material.sheen_color))
    words = {
        "specular": ("F0 up to {:.2g} %", 8.0, no_specular),
        "metallic": ("metallic up to {:.2g}", 1.0, "no metal anywhere"),
        "clearcoat": ("covers up to {:.2g} %", 100.0, "no map"),
        "sheen": ("weight up to {:.2g}", 1.0, "no map"),
    }
    out = []
    for name, (text, unit, absent) in words.items():
        share = getattr(material, name)
        strength = 0.0 if share is None else float(np.max(share)) * (tint if name == "sheen" else 1.0)
        if strength > 0.0:
            faint = name in measured and strength * LAYERS[name] < FAINT
            bound = _faint_bound(scene, name, strength * LAYERS[name]) if faint else None
            out.append(Effect(name, True, text.format(strength * unit), bound, "pilot" if faint else "exact"))
        else:
            out.append(Effect(name, False, absent, 0.0, present=False))
    return out


def _faint_bound(scene: Analysis, name: str, strength: float) -> float | None:
    """Bias bound of leaving out a faint layer. Noise would hide its effect, so a pilot measures the layer at
    full strength and the result is scaled down."""
    if not scene.pilots:
        return None
    material = scene.job.material
    full: dict[str, Any] = {name: np.asarray(getattr(material, name)) / strength}
    job = Job(scene.job.config, replace(material, **full))
    plan = reference_plan(job)
    return FAINT_CAUTION * strength * Pilot(job, plan).changed(without(plan, name)).bound()


def _measured_transmission(
    scene: Analysis, request: EffectsRequest, decided: dict[str, Effect], left: float
) -> Effect:
    """The decision on transmission through fibers, by a pilot with and without it."""
    effect = decided["transmission"]
    requested = "transmission" in request.forced or request.base != "auto"
    if not effect.present or requested or not scene.pilots:
        return effect
    many = decide(request, Effect("interreflection", True, scene.kind))
    on = {**decided, "interreflection": many}
    plan = _assemble(scene.job, consistent(on, request), scene.job.config.transport.max_depth)
    change = Pilot(scene.job, plan).changed(without(plan, "transmission"))
    upper = change.bound()
    if upper <= left:
        return replace(effect, on=False, bias_bound=upper, reason="pilot")
    return replace(effect, bias_bound=change.rms, reason="pilot")


def _displacement_plan(
    scene: Analysis,
    request: EffectsRequest,
    decided: dict[str, Effect],
    bounds: DisplacementBounds | None,
    left: float,
) -> EffectsPlan:
    """The plan, given the decisions on the surface: decides on displacement and on BSDF sampling."""
    job = scene.job
    cap = job.config.transport.max_depth
    decided["bsdf_sampling"] = decide(request, bsdf_sampling(scene))
    decided["transmission"] = decide(request, transmission(scene))
    black = not scene.albedo.any() and scene.lambert and not decided["opacity"].on
    if scene.flat or black:
        text = "flat" if scene.flat else "black: reflects nothing"
        for name in DISPLACEMENT_EFFECTS:
            decided[name] = decide(request, Effect(name, False, text, 0.0))
        return _assemble(job, consistent(decided, request), cap)
    shadowing = _shadowing(scene, bounds)
    parallax = Effect(
        "parallax",
        True,
        f"displacement range {100.0 * job.displacement_range:.2g} % of the tile's width",
        bounds.parallax if bounds else None,
        "pilot",
    )
    if scene.shape is not None:
        text = f"{scene.kind}, {100.0 * scene.shape.thickness:.2g} % of the tile's width thick"
        parallax = Effect("parallax", True, text, present=False)
    bounces = _bounce_bound(scene) if bounds is not None and bounds.parallax <= left else 0.0
    if bounds is not None and bounds.parallax + bounces <= left:
        # Without the displaced tile its other effects are off too; the sum includes their bounds.
        parallax = replace(parallax, on=False, bias_bound=bounds.parallax + bounces)
        for name in DISPLACEMENT_EFFECTS[1:]:
            decided[name] = decide(request, Effect(name, False, "no displacement", 0.0, "pilot"))
        decided["parallax"] = decide(request, parallax)
        return _assemble(job, consistent(decided, request), cap)
    decided["parallax"] = decide(request, parallax)
    if shadowing.bias_bound is not None and shadowing.bias_bound <= left / 2:
        left -= shadowing.bias_bound
        shadowing = replace(shadowing, on=False)
    decided["shadowing"] = decide(request, shadowing)
    decided["transmission"] = _measured_transmission(scene, request, decided, left)
    if not decided["transmission"].on:
        left -= decided["transmission"].bias_bound or 0.0
    decided["interreflection"], cap, bound = _interreflection(scene, request, decided, left)
    return _assemble(job, consistent(decided, request), cap, bound)


def _shadowing(scene: Analysis, bounds: DisplacementBounds | None) -> Effect:
    config = scene.job.config
    # Elevation in radians below which the cut light lobe has no light; ≤ 0 if there is none.
    lowest = float(np.arcsin(config.queries.min_cos) - LOBE_TAIL * np.radians(config.light.width))
    if scene.shape is not None:
        return Effect("shadowing", True, scene.kind)
    slopes = f"slopes up to {_degrees(scene.steepest)}"
    if lowest > 0 and scene.steepest <= np.tan(lowest):
        text = f"{slopes}, light and its kernel no lower than {_degrees(np.tan(lowest))}"
        below = LOBE_TAIL_SHARE if config.light.width > 0 else 0.0
        return Effect("shadowing", True, text, below, "bound")
    least = "the horizon" if lowest <= 0 else _degrees(np.tan(lowest))
    text = f"{slopes}, light and its kernel down to {least}"
    return Effect("shadowing", True, text, bounds.shadowing if bounds else None, "pilot")


def _degrees(slope: float) -> str:
    angle = float(np.degrees(np.arctan(slope)))
    return f"{angle:.0f}°" if angle >= 10.0 else f"{angle:.1g}°"


def _bounce_bound(scene: Analysis) -> float:
    """Upper bound of interreflection between gentle slopes. A facet of slope s sees others only within
    2·atan(s) of its plane, a share sin² of its cosine-weighted hemisphere. No facet receives more than 1/E,
    with E the irradiance of a unit lobe on the plane. Bright texels may be rare, so the bound includes the
    ratio of root mean square to mean albedo."""
    job, albedo = scene.job, scene.albedo
    brightest = float(albedo.max())
    share = brightest * np.sin(min(2.0 * np.arctan(scene.steepest), 0.5 * np.pi)) ** 2
    low = job.config.queries.min_cos
    direction = np.array([[np.sqrt(1.0 - low * low), 0.0, low]])
    strongest = 1.0 / float(LightKernel(job.config.light.width).irradiance(direction)[0])
    uneven = float(np.sqrt(np.mean(albedo**2))) / max(float(np.mean(albedo)), 1e-12)
    return float(uneven * strongest * share / max(1.0 - share, 1e-12))


def _interreflection(
    scene: Analysis, request: EffectsRequest, decided: dict[str, Effect], left: float
) -> tuple[Effect, int, float]:
    """(interreflection, cap on interactions, the cap's bias bound), by a pilot with and without them on the
    same random numbers."""
    depth = scene.job.config.transport.max_depth
    effect = Effect("interreflection", True, scene.kind)
    if depth == 1:
        off = Effect("interreflection", False, "max_depth 1", reason="forced")
        return decide(request, off), 1, 0.0
    if "interreflection" in request.forced or request.base != "auto" or not decided["parallax"].on:
        return decide(request, effect), depth, 0.0
    most = _bounce_bound(scene) if scene.lambert else np.inf
    text = "light scattered by several fibers" if scene.kind == "fibers" else "light between facets"
    if most <= left:
        text += f"; slopes up to {_degrees(scene.steepest)} interreflect little"
        return Effect("interreflection", False, text, most, "bound"), 1, 0.0
    if not scene.pilots:
        return (
            replace(effect, explanation=f"{effect.explanation}; the run is too small for a pilot"),
            depth,
            0.0,
        )
    pilot = Pilot(
        scene.job,
        _assemble(scene.job, consistent({**decided, "interreflection": effect}, request), depth),
    )
    change = pilot.limited(1)
    upper = change.bound(most)
    if upper <= left:
        return Effect("interreflection", False, text, upper, "pilot"), 1, 0.0
    found = Effect("interreflection", True, text, change.rms, "pilot")
    if depth:
        return found, depth, 0.0
    # Each further interaction keeps at most the largest albedo of the light: skip caps that cannot suffice.
    brightest = float(scene.albedo.max())
    for cap in range(2, DEEPEST_CAP + 1):
        if change.rms * brightest ** (cap - 1) > 2.0 * left:
            continue
        upper = pilot.limited(cap).bound()
        if upper <= left:
            text += f"; paths end after {cap} interactions; further ones add less than {100.0 * upper:.1g} %"
            return replace(found, explanation=text), cap, upper
    return replace(found, explanation=f"{text}; Russian roulette ends paths, without a limit"), 0, 0.0


def _assemble(job: Job, decided: dict[str, Effect], cap: int, bound: float = 0.0) -> EffectsPlan:
    effects = tuple(decided[name] for name in EFFECTS)
    return EffectsPlan(effects, cap, bound, job.config.transport.roulette_depth)


def _has_closed_form(scene: Analysis, plan: EffectsPlan) -> bool:
    """Whether M follows without tracing: a plane of one Lambert color, or black."""
    if plan.names_on & {*LAYERS, "opacity"} or scene.own_bsdf:
        return False
    base = np.asarray(scene.job.material.base_color)
    if not base.any():
        return True
    one = bool(np.all(base == base.reshape(-1, 3)[0]))
    return one and scene.flat and not plan.names_on & {"parallax", "normal"}
