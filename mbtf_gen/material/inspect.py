"""Statistics of a material for ``mbtf-gen inspect``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.color import linear_to_srgb
from mbtf_gen.geometry.slope_statistics import detail_size, repeats, rms_slope, slope_angles
from mbtf_gen.images.read import LUMINANCE
from mbtf_gen.material.checks import misses
from mbtf_gen.material.material import MAPS, Material
from mbtf_gen.material.tiling import broken

# Luminance from charcoal to fresh snow; outside, a color map is probably not albedo.
ALBEDO_RANGE = (0.02, 0.95)
# A color map that varies by less (RMS of the sRGB-encoded channels) is almost one color.
_CONSTANT = 0.05
# Half width of the autocorrelation, in texels, below which detail is reported as fine.
_FINE = 4.0
# Fraction of the map's RMS slope below which a mesh is reported.
_KEPT = 0.9
# Texels above which few distinct floats indicate quantization.
_MANY = 4096
# Levels below which 8-bit heights are reported.
_FEW_LEVELS = 128


def inspect_material(
    material: Material, height: float | None = None, mesh: int | None = None
) -> dict[str, Any]:
    """Collect the statistics of a material.

    Parameters
    ----------
    material : Material
    height, mesh : float or None, int or None
        As in :meth:`mbtf_gen.material.material.Material.grid`.

    Returns
    -------
    dict
        Plain data; ``oddities`` lists unusual properties in words.
    """
    grid = material.grid(height, mesh)
    factor = material.height_scale if height is None else height
    full = material.grid(height, material.height.shape[1])
    median, high, steepest = slope_angles(grid)
    whole = rms_slope(full)
    default = "material" if material.height_given else "default"
    found: dict[str, Any] = {
        "aspect": material.aspect,
        "tile": material.tile,
        "maps": {
            role: {**asdict(facts), "file": str(facts.file), "names": list(facts.names)}
            for role, facts in material.facts.items()
        },
        "constants": _constants(material),
        "surface": _surface(material),
        "geometry": {
            "height": factor,
            "material_height": material.height_scale,
            "height_from": default if height is None else "asked",
            "map": list(material.height.shape),
            "mesh": list(grid.z.shape),
            "relief": abs(grid.displacement_range),
            "slope_median_deg": median,
            "slope_p99_deg": high,
            "slope_max_deg": steepest,
            "slope_kept": rms_slope(grid) / whole if whole > 0 else 1.0,
        },
        "heights": {
            "codes": None if material.codes is None else asdict(material.codes),
            "distinct": len(np.unique(material.height)),
            "low": float(material.height.min()),
            "high": float(material.height.max()),
            "rms_step": _rms_step(material),
            "detail_texels": detail_size(material.height),
            "repeats": [repeats(material.height, axis) for axis in (1, 0)],
        },
        "tiling": [{**asdict(s), "ratio": s.ratio, "tiles": not broken(s)} for s in material.seams],
        "albedo": _albedo(material),
        "normal": _normal(material, factor),
        "opacity": _opacity(material),
        "unused": material.unused,
        "warnings": list(material.warnings_at(height)),
        "notes": list(material.notes),
    }
    warned = found["geometry"]["height_from"] == "default" and misses(material.normal_fit, factor)
    suggested = [] if warned else _suggestion_oddity(found)
    return {**found, "oddities": [*_oddities(found), *_surface_oddities(found), *suggested]}


def _rms_step(material: Material) -> float:
    """Root mean square difference of neighboring columns, relative to the range of the heights."""
    steps = np.roll(material.height, -1, 1) - material.height
    extent = float(np.ptp(material.height))
    return float(np.sqrt(np.mean(steps**2))) / extent if extent > 0 else 0.0


def _constants(material: Material) -> dict[str, Any]:
    """What is one number or color for the whole tile."""
    roles = (r for r in MAPS if r not in ("height", "normal"))
    values = {r: getattr(material, r) for r in roles if r != "base_color" or material.bsdf is None}
    return {n: np.asarray(v).tolist() for n, v in values.items() if v is not None and np.ndim(v) < 2}


def _surface(material: Material) -> str:
    if material.bsdf is not None:
        return str(material.bsdf["type"])
    return "diffuse" if material.is_lambert else "glossy"


def _albedo(material: Material) -> dict[str, Any] | None:
    if material.bsdf is not None:
        return None
    color = np.asarray(material.base_color, np.float64)
    luminance = color @ np.asarray(LUMINANCE)
    mean = color.reshape(-1, 3).mean(axis=0)
    encoded = np.asarray(linear_to_srgb(color), np.float64)
    spread = float(np.sqrt(np.mean((encoded - encoded.reshape(-1, 3).mean(axis=0)) ** 2)))
    low, high = ALBEDO_RANGE
    return {
        "min": float(luminance.min()),
        "median": float(np.median(luminance)),
        "max": float(luminance.max()),
        "mean_rgb": mean.tolist(),
        "spread_srgb": spread,
        "share_above": float(np.mean(luminance > high)),
        "share_below": float(np.mean(luminance < low)),
        "plausible": [low, high],
        "given": "base_color" in material.facts,
    }


def _normal(material: Material, factor: float) -> dict[str, Any] | None:
    if material.normal is None:
        return None
    out: dict[str, Any] = {"convention": material.normal_convention}
    tilt = np.degrees(np.arccos(np.clip(material.normal[..., 2], -1.0, 1.0)))
    out["tilt_median_deg"], out["tilt_p99_deg"] = (float(p) for p in np.percentile(tilt, (50, 99)))
    fit = material.normal_fit
    if fit is not None:
        sign = 1.0 if material.normal_convention == "gl" else -1.0
        shown = asdict(fit)
        out |= {**shown, "convention": material.normal_convention, "shown_convention": shown["convention"]}
        out["correlation_v"] = sign * fit.correlation_v
        out["suggested_height"] = fit.scale if fit.fits else None
        out["height_in_use"] = factor
    return out


def _opacity(material: Material) -> dict[str, Any] | None:
    if material.opacity is None:
        return None
    opacity = np.asarray(material.opacity)
    return {
        "holes": float(np.mean(opacity < 0.5)),
        "partly": float(np.mean((opacity > 0.02) & (opacity < 0.98))),
    }


def _oddities(found: dict[str, Any]) -> list[str]:
    out = []
    height, heights, geometry = found["maps"]["height"], found["heights"], found["geometry"]
    rows, columns = height["rows"], height["columns"]
    if rows != columns:
        out.append(f"the tile is not square: {columns} x {rows} texels, 1 wide and {found['aspect']:g} high")
    if height["channels"] > 1:
        out.append(f"{Path(height['file']).name}: gray stored in {height['channels']} channels")
    codes = heights["codes"]
    if codes is not None and height["bits"] == 8 and 1 < codes["levels"] < _FEW_LEVELS:
        out.append(
            f"heights have only {codes['levels']} distinct values, codes {codes['low']} to {codes['high']}"
        )
    if height["bits"] is None and 1 < heights["distinct"] <= 256 and rows * columns > _MANY:
        out.append(
            f"heights are floats with only {heights['distinct']} distinct values: "
            "if they were converted from integers, "
            "they form terraces"
        )
    if Path(height["file"]).suffix.lower() in (".jpg", ".jpeg"):
        out.append("heights come from a JPG: its compression is part of the surface")
    if geometry["relief"] > 0 and heights["detail_texels"] < _FINE:
        out.append(
            f"fine detail: the correlation of heights falls to half within "
            f"{heights['detail_texels']:.1f} texels, "
            f"RMS step {heights['rms_step']:.0%} of the range per texel"
        )
    if max(heights["repeats"]) > 1:
        u, v = heights["repeats"]
        out.append(f"the heights repeat {u} x {v} times (u x v) within the tile")
    if geometry["slope_kept"] < _KEPT:
        out.append(
            f"the mesh keeps {geometry['slope_kept']:.0%} of the map's RMS slope; "
            f"--mesh {geometry['map'][1]} keeps all"
        )
    return out


def _surface_oddities(found: dict[str, Any]) -> list[str]:
    out = []
    albedo, opacity = found["albedo"], found["opacity"]
    if albedo is not None:
        if not albedo["given"] and "base_color" in found["constants"]:
            shown = ", ".join(f"{c:.3g}" for c in albedo["mean_rgb"])
            out.append(f"no base color map: linear RGB {shown} everywhere")
        elif albedo["given"] and albedo["spread_srgb"] < _CONSTANT:
            codes = 255.0 * albedo["spread_srgb"]
            out.append(f"the base color is almost constant: {codes:.1f} of 255 codes RMS")
        if albedo["share_above"] > 0:
            out.append(
                f"{albedo['share_above']:.2%} of the albedo lies above {ALBEDO_RANGE[1]}: brighter than snow"
            )
        if albedo["share_below"] > 0.5:
            out.append(
                f"{albedo['share_below']:.0%} of the albedo lies below {ALBEDO_RANGE[0]}: blacker than coal"
            )
    metallic = found["maps"].get("metallic")
    if metallic is not None and metallic["low"] < metallic["high"]:
        low, high = metallic["low"], metallic["high"]
        out.append(f"metallic varies from {low:.2g} to {high:.2g}: metal and dielectric mixed")
    if opacity is not None and opacity["holes"] > 0:
        out.append(f"holes: {opacity['holes']:.1%} of the tile is see-through")
    return out


def _suggestion_oddity(found: dict[str, Any]) -> list[str]:
    suggested = None if found["normal"] is None else found["normal"].get("suggested_height")
    if not suggested:
        return []
    ratio = found["geometry"]["height"] / suggested
    if 0.8 < ratio < 1.25:
        return []
    return [f"the height scale in use is {ratio:.3g} times the {suggested:.3g} that the normal map suggests"]
