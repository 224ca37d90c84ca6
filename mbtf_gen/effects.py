"""Which effects of light a run simulates, and why: stored in the manifest, printed at the end."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .config import GeneratorConfig

if TYPE_CHECKING:
    from .material import Material


def simulated_effects(material: Material, config: GeneratorConfig) -> list[dict[str, Any]]:
    """Effects as ``{effect, on, reason}``, in the order in which light meets them."""
    grid = material.grid(config.geometry.height, config.geometry.mesh)
    flat = grid.relief == 0.0
    relief = f"relief of {grid.relief:.4g} tile widths"
    depth = config.transport.max_depth
    bounces = "no depth limit, Russian roulette" if depth == 0 else f"at most {depth} surface interactions"
    lambert = material.is_lambert
    out = [
        ("parallax and masking", not flat, "flat" if flat else relief),
        ("shadowing", not flat, "flat" if flat else relief),
        (
            "interreflection",
            not flat and depth != 1,
            "flat" if flat else ("depth limit 1" if depth == 1 else bounces),
        ),
        ("periodic neighbours", not flat, "flat" if flat else "rays re-enter the tile"),
        ("specular lobe", not lambert, "Lambert: no roughness, metallic or specular" if lambert else "given"),
        (
            "smoothed light",
            config.light.width > 0,
            f"RMS width {config.light.width:g} degrees per axis" if config.light.width > 0 else "delta light",
        ),
        ("normal map", False, "not simulated yet" if material.normal is not None else "no map"),
        ("opacity", False, "not simulated yet" if material.opacity is not None else "no map"),
    ]
    return [{"effect": name, "on": bool(on), "reason": reason} for name, on, reason in out]
