"""The effects of light, one class each: a new one is a class here and what it adds to the simulation."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from mbtf_core.images.resample import resample
from mbtf_core.units import percent
from mbtf_gen.planning.scene import Effect, EffectDecision, PlanScene
from mbtf_gen.sampling.light_kernel import LightKernel

# The light lobe is cut at this many standard deviations; the second number is the tail of a Gaussian there.
LOBE_TAIL = 3.5
LOBE_TAIL_SHARE = 2.4e-4
# Deepest cap on surface interactions that is tried.
DEEPEST_CAP = 4
# A layer below this strength may be negligible: a pilot measures it.
FAINT = 0.05
# Safety factor on the bias of a faint layer, which we scale down from that of a full one. Scaling is exact
# except for light that meets the layer more than once.
FAINT_CAUTION = 2.0
# Next-event estimation alone has no more variance than both techniques if the narrowest lobe of the surface,
# about 2α wide, is at least this many times wider than the light's.
WIDER = 4.0


class ReflectionLayer(Effect):
    """A term of how the surface reflects, whose weight is the map of its name.

    Attributes
    ----------
    scale : from the weight to the strength, of which 1 is a full layer
    text, unit : explanation, and the unit of the weight in it
    lacking : why the material has no such layer
    """

    stage = "reflection"
    alters_tile = True
    scale: ClassVar[float] = 1.0
    text: ClassVar[str]
    unit: ClassVar[float] = 1.0
    lacking: ClassVar[str] = "no map"

    def propose(self, scene: PlanScene) -> EffectDecision:
        """On where the weight is positive somewhere; a faint layer's bias is measured."""
        if scene.tile.bsdf_type is not None:
            text = f"the material's own BSDF '{scene.tile.bsdf_type}', not analyzed"
            return self.decision(False, text, 0.0, present=False)
        weight = scene.tile.weight(self.name)
        if weight <= 0.0:
            return self.decision(False, self.lacking, 0.0, present=False)
        strength, text = weight * self.scale, self.text.format(weight * self.unit)
        if scene.pilots is None or strength >= FAINT or not scene.is_auto(self.name):
            return self.decision(True, text)
        if self.name not in scene.tile.maps:
            return self.decision(True, text)  # of a part of a mesh
        # Noise would hide its effect, so a pilot measures the layer at full strength, and the result is
        # scaled down.
        bound = FAINT_CAUTION * strength * scene.pilots.change_of_layer(self.name, strength).bound()
        return self.decision(True, text, bound, "pilot")


class Specular(ReflectionLayer):
    """The dielectric lobe; that of an own BSDF cannot be switched."""

    name, description = "specular", "specular lobe"
    # A specular of 1/4 (F0 = 2%) is the smallest that reflects everything at grazing angles.
    scale, text, unit = 4.0, "F0 up to {:.2g}%", 8.0
    lacking = "no roughness, metallic or specular, or specular 0"

    def propose(self, scene: PlanScene) -> EffectDecision:
        """As any layer, but on where the material has its own BSDF."""
        found = super().propose(scene)
        if scene.tile.bsdf_type is None:
            return found
        return self.decision(True, found.explanation, present=False)


class Metallic(ReflectionLayer):
    """Metal in place of the base layer."""

    name, description = "metallic", "metallic"
    scale, text = math.inf, "metallic up to {:.2g}"
    lacking = "no metal anywhere"


class Clearcoat(ReflectionLayer):
    """The clear coat above the base layer."""

    name, description = "clearcoat", "clearcoat"
    text, unit = "covers up to {:.3g}%", 100.0


class Sheen(ReflectionLayer):
    """The sheen above all."""

    name, description = "sheen", "sheen"
    text = "weight up to {:.2g}"


class NormalMap(Effect):
    """Slopes that the mesh lacks."""

    name, description, stage, alters_tile = "normal", "normal map", "maps", True

    def propose(self, scene: PlanScene) -> EffectDecision:
        """On where the map adds slopes, with the bound of a Lambert surface."""
        if scene.mapped is None:
            text = "off in the configuration" if "normal" in scene.tile.maps else "no map"
            text = "the material has its own BSDF" if scene.tile.bsdf_type is not None else text
            return self.decision(False, text, 0.0, present=False)
        slopes, share = scene.mapped
        rms = float(np.sqrt(np.mean(np.sum(slopes**2, axis=-1))))
        text = f"adds slopes of {np.degrees(np.arctan(rms)):.2g}° (RMS)"
        if scene.normal_mode == "residual" and not scene.flat:
            part = "" if share > 0.995 else f"{100.0 * share:.0f}% of "
            text += f"; {part}the mesh's slopes are also in the map and are counted once"
        if rms == 0.0:
            return self.decision(False, text, 0.0)
        return self.decision(True, text, scene.bounds.normal if scene.bounds else None, "pilot")


class Opacity(Effect):
    """Holes."""

    name, description, stage, alters_tile = "opacity", "opacity", "maps", True

    def propose(self, scene: PlanScene) -> EffectDecision:
        """On where rays can pass, with the bound of a Lambert surface."""
        tile = scene.tile
        if tile.grid is None:
            return self.decision(True, f"rays can pass through the {tile.kind}", present=False)
        through = scene.passing
        if through is None:
            text = "no map"
            if "opacity" in tile.maps:
                text = "own BSDF" if tile.bsdf_type is not None else "opaque everywhere"
            return self.decision(False, text, 0.0, present=False)
        text = f"{percent(float(through.mean()))} of the rays that meet the surface pass through"
        if not scene.lambert:
            return self.decision(True, text)
        if not scene.flat:
            return self.decision(True, text, scene.bounds.opacity if scene.bounds else None, "pilot")
        # M of a plane is its color times its opacity.
        rows, columns = (max(a, b) for a, b in zip(through.shape, scene.albedo.shape[:2], strict=True))
        passed = np.asarray(resample(through, rows, columns), np.float64)[..., None]
        color = np.asarray(resample(scene.albedo, rows, columns), np.float64)
        mean = float(np.mean((1.0 - passed) * color))
        bound = float(np.sqrt(np.mean((passed * color) ** 2))) / mean if mean > 0 else None
        return self.decision(True, text, bound, "bound")


class BsdfSampling(Effect):
    """Light found by sampling the BSDF, which next-event estimation finds only with high variance."""

    name, description, stage = "bsdf_sampling", "BSDF sampling of light", "transport"
    switch = "bsdf_sampling"

    def propose(self, scene: PlanScene) -> EffectDecision:
        """On where the surface has lobes about as narrow as the light's."""
        width, found = np.radians(scene.light_width), scene.tile.narrowest_lobe()
        if width == 0.0:
            return self.decision(False, "samples of the BSDF never hit a delta light", 0.0)
        if found is None:
            return self.decision(True, "the material's own BSDF, not analyzed")
        if scene.lambert and scene.tile.bsdf_type is None:
            if scene.light_width <= 20.0:
                text = f"Lambert under a light of {scene.light_width:g}°: sampling the light is best"
                return self.decision(False, text, 0.0)
            return self.decision(True, "a wide light")
        lobe, what = found
        text = f"{what} {np.degrees(lobe):.2g}°, light {scene.light_width:g}°"
        if lobe >= WIDER * width:
            return self.decision(False, f"{text}: sampling the light suffices", 0.0)
        return self.decision(True, text)

    def reference(self, scene: PlanScene) -> EffectDecision:
        """Always on."""
        return self.decision(True, "reference")


class Displacement(Effect):
    """An effect of displaced surfaces only."""

    stage = "transport"
    displaced = True

    def reference(self, scene: PlanScene) -> EffectDecision:
        """On unless the tile is flat."""
        return self.decision(not scene.flat, "flat" if scene.flat else scene.tile.kind)

    def propose(self, scene: PlanScene) -> EffectDecision:
        """Off without a displaced surface."""
        if scene.undisplaced is None:
            return self.on_displaced(scene)
        text, reason = scene.undisplaced
        return self.decision(False, text, 0.0, reason)

    def on_displaced(self, scene: PlanScene) -> EffectDecision:
        """The decision for a displaced surface."""
        raise NotImplementedError


class Parallax(Displacement):
    """The displaced surface itself, in place of the reference plane with its slopes."""

    name, description, alters_tile = "parallax", "parallax and masking", True
    switch = "displacement"

    def propose(self, scene: PlanScene) -> EffectDecision:
        """On where the tile is no height field: no plane has its gaps and its parts, even if it is flat."""
        if scene.tile.grid is None:
            text = f"{scene.tile.kind}, {percent(scene.tile.thickness)} of the tile's width thick"
            return self.decision(True, text, present=False)
        return super().propose(scene)

    def reference(self, scene: PlanScene) -> EffectDecision:
        """The same, and on for all height fields that are not flat."""
        return self.propose(scene) if scene.tile.grid is None else super().reference(scene)

    def on_displaced(self, scene: PlanScene) -> EffectDecision:
        """Off where the sum of the bounds of all effects of displacement is small enough."""
        bounds = scene.bounds
        text = f"displacement range {percent(scene.tile.thickness)} of the tile's width"
        if bounds is None:
            return self.decision(True, text, None, "pilot")
        bounces = bounce_bound(scene) if bounds.parallax <= scene.left else 0.0
        if bounds.parallax + bounces > scene.left:
            return self.decision(True, text, bounds.parallax, "pilot")
        # Without the displaced tile its other effects are off too; the sum includes their bounds.
        scene.undisplaced = "no displacement", "pilot"
        return self.decision(False, text, bounds.parallax + bounces, "pilot")


class Shadowing(Displacement):
    """Shadows of the surface on itself."""

    name, description, order = "shadowing", "shadowing", 1
    switch = "shadowing"

    def on_displaced(self, scene: PlanScene) -> EffectDecision:
        """Off where the bound takes at most half of what is left."""
        if scene.tile.grid is None:
            return self.decision(True, scene.tile.kind)
        # Elevation in radians below which the cut light lobe has no light; ≤ 0 if there is none.
        lowest = float(np.arcsin(scene.min_cos) - LOBE_TAIL * np.radians(scene.light_width))
        slopes = f"slopes up to {_degrees(scene.steepest)}"
        if lowest > 0 and scene.steepest <= np.tan(lowest):
            text = f"{slopes}, light and its kernel no lower than {_degrees(np.tan(lowest))}"
            found = self.decision(True, text, LOBE_TAIL_SHARE if scene.light_width > 0 else 0.0, "bound")
        else:
            least = "the horizon" if lowest <= 0 else _degrees(np.tan(lowest))
            text = f"{slopes}, light and its kernel down to {least}"
            found = self.decision(True, text, scene.bounds.shadowing if scene.bounds else None, "pilot")
        if found.bias_bound is None or found.bias_bound > scene.left / 2:
            return found
        scene.left -= found.bias_bound
        return self.decision(False, text, found.bias_bound, found.reason)


class Transmission(Effect):
    """Light that passes through fibers."""

    name, description, stage, alters_tile = "transmission", "fiber transmission", "transport", True
    order = 2

    def propose(self, scene: PlanScene) -> EffectDecision:
        """Off where a pilot with and without it shows little change."""
        found = self.reference(scene)
        if not found.present or scene.pilots is None or not scene.is_auto(self.name):
            return found
        many = EffectDecision("interreflection", True, scene.tile.kind)
        change = scene.pilots.change_without(self.name, {self.name: found, many.name: many})
        upper = change.bound()
        if upper > scene.left:
            return self.decision(True, found.explanation, change.rms, "pilot")
        scene.left -= upper
        return self.decision(False, found.explanation, upper, "pilot")

    def reference(self, scene: PlanScene) -> EffectDecision:
        """On for fibers."""
        if not scene.tile.scatters:
            return self.decision(False, "no fibers", 0.0, present=False)
        return self.decision(True, "light passes through fibers")


class Interreflection(Displacement):
    """Light that meets the surface more than once."""

    name, description, order = "interreflection", "interreflection", 3
    switch = "interreflection"

    def on_displaced(self, scene: PlanScene) -> EffectDecision:
        """Off, or with a cap on interactions, where pilots without and with them show little change."""
        if scene.max_depth == 1:
            return self.decision(False, "max_depth 1", None, "forced")
        kind = scene.tile.kind
        if not scene.is_auto(self.name) or not scene.decided["parallax"].on:
            return self.decision(True, kind)
        most = bounce_bound(scene) if scene.lambert and scene.tile.grid is not None else np.inf
        text = "light scattered by several fibers" if scene.tile.scatters else "light between facets"
        if most <= scene.left:
            text += f"; slopes up to {_degrees(scene.steepest)} interreflect little"
            scene.cap = 1
            return self.decision(False, text, most, "bound")
        if scene.pilots is None:
            return self.decision(True, f"{kind}; the run is too small for a pilot")
        limited = scene.pilots.capped({self.name: self.decision(True, kind)})
        change = limited(1)
        upper = change.bound(most)
        if upper <= scene.left:
            scene.cap = 1
            return self.decision(False, text, upper, "pilot")
        if scene.max_depth:
            return self.decision(True, text, change.rms, "pilot")
        # Each further interaction keeps at most the largest albedo of the light: skip caps that cannot
        # suffice.
        brightest = float(scene.albedo.max())
        for cap in range(2, DEEPEST_CAP + 1):
            if change.rms * brightest ** (cap - 1) > 2.0 * scene.left:
                continue
            upper = limited(cap).bound()
            if upper <= scene.left:
                scene.cap, scene.cap_bound = cap, upper
                text += f"; paths end after {cap} interactions; "
                text += f"further ones add less than {percent(upper, 1)}"
                return self.decision(True, text, change.rms, "pilot")
        text += "; Russian roulette ends paths, without a limit"
        return self.decision(True, text, change.rms, "pilot")


def bounce_bound(scene: PlanScene) -> float:
    """Upper bound of interreflection between gentle slopes. A facet of slope s sees others only within
    2·atan(s) of its plane, a share sin² of its cosine-weighted hemisphere. No facet receives more than 1/E,
    with E the irradiance of a unit lobe on the plane. Bright texels may be rare, so the bound includes the
    ratio of root mean square to mean albedo."""
    albedo: NDArray[np.float64] = scene.albedo
    brightest = float(albedo.max())
    share = brightest * np.sin(min(2.0 * np.arctan(scene.steepest), 0.5 * np.pi)) ** 2
    low = scene.min_cos
    direction = np.array([[np.sqrt(1.0 - low * low), 0.0, low]])
    strongest = 1.0 / float(LightKernel(scene.light_width).irradiance(direction)[0])
    uneven = float(np.sqrt(np.mean(albedo**2))) / max(float(np.mean(albedo)), 1e-12)
    return float(uneven * strongest * share / max(1.0 - share, 1e-12))


def _degrees(slope: float) -> str:
    angle = float(np.degrees(np.arctan(slope)))
    return f"{angle:.0f}°" if angle >= 10.0 else f"{angle:.1g}°"


# All effects by name, in the order of plans and tables.
EFFECTS: dict[str, Effect] = {
    effect.name: effect
    for effect in (
        Parallax(),
        Shadowing(),
        Interreflection(),
        Specular(),
        Metallic(),
        Clearcoat(),
        Sheen(),
        Transmission(),
        NormalMap(),
        Opacity(),
        BsdfSampling(),
    )
}
