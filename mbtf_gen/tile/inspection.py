"""Statistics of a material for ``mbtf-gen inspect``, as data and as text."""

from __future__ import annotations

import math
import textwrap
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_gen.images.read import LUMINANCE
from mbtf_gen.tile.heightfield_tile import MAPS, Material, layers_above
from mbtf_gen.tile.heights.grid import HeightGrid
from mbtf_gen.tile.heights.statistics import detail_size, repeats, rms_slope, slope_angles
from mbtf_gen.tile.maps.checks import CONVENTION_NAMES, displacement_fault, signed
from mbtf_gen.tile.maps.tiling import broken

# Luminance from charcoal to fresh snow; outside, a color map is probably not albedo.
ALBEDO_RANGE = (0.02, 0.95)
# Fraction of the map's RMS slope below which a mesh is reported.
_KEPT = 0.9
# Texels above which few distinct floats indicate quantization.
_MANY = 4096
# Width to which long texts are wrapped.
_WIDTH = 100

# What each map does to the simulation.
USES = {
    "height": "displaces the mesh",
    "base_color": "reflectance",
    "roughness": "width of the specular lobe",
    "metallic": "fraction of metal",
    "specular": "strength of the dielectric lobe",
    "clearcoat": "weight of the clear coat",
    "clearcoat_roughness": "roughness of the clear coat",
    "sheen": "weight of the sheen",
    "sheen_color": "color of the sheen",
    "sheen_roughness": "roughness of the sheen",
    "normal": "slopes that the mesh lacks",
    "opacity": "holes",
}
_KINDS = {1: "gray", 2: "gray+alpha", 3: "RGB", 4: "RGBA"}


def inspect_material(
    material: Material,
    height: float | None = None,
    mesh: int | None = None,
    finest: int | None = None,
    max_displacement: float = math.inf,
) -> dict[str, Any]:
    """Collect the statistics of a material.

    Parameters
    ----------
    material : Material
    height, mesh : float or None, int or None
        As in :meth:`mbtf_gen.tile.heightfield_tile.Material.grid`.
    finest : int or None
        As in :meth:`mbtf_gen.tile.heightfield_tile.Material.lattice`.
    max_displacement : float
        Largest displacement range that generation accepts, in tile widths.

    Returns
    -------
    dict
        Plain data; ``oddities`` lists unusual properties in words.
    """
    grid = material.grid(height, mesh)
    median, high, steepest = slope_angles(grid)
    whole = rms_slope(material.grid(height, material.height.shape[1]))
    constants = {role: getattr(material, role) for role in MAPS if role not in ("height", "normal")}
    if material.bsdf is not None:
        del constants["base_color"]
    found: dict[str, Any] = {
        "aspect": material.aspect,
        "make_tileable": material.tile,
        "resolution": material.lattice(finest).shape()[1],
        "maps": {role: {**asdict(f), "file": str(f.file)} for role, f in material.facts.items()},
        "constants": {
            role: np.asarray(value).tolist()
            for role, value in constants.items()
            if value is not None and np.ndim(value) < 2
        },
        "surface": material.bsdf["type"] if material.bsdf else "diffuse" if material.is_lambert else "glossy",
        "geometry": {
            "height_scale": material.height_scale if height is None else height,
            "height_scale_from": material.height_source(height),
            "map": list(material.height.shape),
            "mesh": list(grid.z.shape),
            "displacement_range": abs(grid.displacement_range),
            "slope_median_deg": median,
            "slope_p99_deg": high,
            "slope_max_deg": steepest,
            "slope_kept": rms_slope(grid) / whole if whole > 0 else 1.0,
        },
        "heights": {
            "codes": None if material.codes is None else asdict(material.codes),
            "distinct": len(np.unique(material.height)),
            "detail_texels": detail_size(material.height),
            "repeats": [repeats(material.height, axis) for axis in (1, 0)],
        },
        "tiling": [{**asdict(s), "ratio": s.ratio, "tiles": not broken(s)} for s in material.seams],
        "albedo": _albedo(material),
        "normal": _normal(material),
        "opacity": _opacity(material),
        "unused": material.unused,
        "warnings": [*material.warnings_at(height), *_refusal(material, grid, max_displacement)],
        "notes": list(material.notes),
    }
    return {**found, "oddities": _oddities(found)}


def _refusal(material: Material, grid: HeightGrid, limit: float) -> list[str]:
    """The warning that generation will refuse the material."""
    fault = displacement_fault(abs(grid.displacement_range), limit)
    return [] if fault is None else [f"{material.files['height']}: generation refuses it: {'; '.join(fault)}"]


def _albedo(material: Material) -> dict[str, Any] | None:
    if material.bsdf is not None:
        return None
    color = np.asarray(material.base_color, np.float64)
    luminance = color @ np.asarray(LUMINANCE)
    low, high = ALBEDO_RANGE
    return {
        "min": float(luminance.min()),
        "median": float(np.median(luminance)),
        "max": float(luminance.max()),
        "mean_rgb": color.reshape(-1, 3).mean(axis=0).tolist(),
        "share_above": float(np.mean(luminance > high)),
        "share_below": float(np.mean(luminance < low)),
    }


def _normal(material: Material) -> dict[str, Any] | None:
    if material.normal is None:
        return None
    tilt = np.degrees(np.arccos(np.clip(material.normal[..., 2], -1.0, 1.0)))
    median, high = (float(p) for p in np.percentile(tilt, (50, 99)))
    out: dict[str, Any] = {"tilt_median_deg": median, "tilt_p99_deg": high}
    fit = material.normal_fit
    if fit is not None:
        sign = 1.0 if material.normal_convention == "gl" else -1.0
        out |= {**asdict(fit), "correlation_v": sign * fit.correlation_v}
        out["suggested_height_scale"] = fit.scale if fit.fits else None
    return {**out, "convention": material.normal_convention}


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
    file, distinct, geometry = found["maps"]["height"], found["heights"]["distinct"], found["geometry"]
    if file["bits"] is None and 1 < distinct <= 256 and file["rows"] * file["columns"] > _MANY:
        out.append(
            f"heights are floats with only {distinct} distinct values: terraces, if they were once integers"
        )
    if Path(file["file"]).suffix.lower() in (".jpg", ".jpeg"):
        out.append("heights come from a JPG: its compression is part of the surface")
    if geometry["slope_kept"] < _KEPT:
        kept, columns = geometry["slope_kept"], geometry["map"][1]
        out.append(f"the mesh keeps {kept:.0%} of the map's RMS slope; --mesh {columns} keeps all")
    albedo = found["albedo"] or {"share_above": 0.0, "share_below": 0.0}
    low, high = ALBEDO_RANGE
    if albedo["share_above"] > 0:
        out.append(f"{albedo['share_above']:.2%} of the albedo lies above {high}: brighter than snow")
    if albedo["share_below"] > 0.5:
        out.append(f"{albedo['share_below']:.0%} of the albedo lies below {low}: blacker than coal")
    return out


def inspection_text(found: dict[str, Any], name: str) -> str:
    """The data of :func:`inspect_material` as text for people."""
    surface = found["surface"] + layers_above({*found["maps"], *found["constants"]})
    lines = [
        f"{name}: tile 1 x {found['aspect']:g}, surface {surface}, make-tileable {found['make_tileable']}, "
        f"resolution {found['resolution']}",
        "",
        *_maps(found),
        *_unused(found),
        "",
        *_geometry(found),
        *_color(found),
        *_normals(found),
    ]
    if written := found.get("written"):
        stored = (f"{name} {c['value']} ({c['reason']})" for name, c in written["choices"].items())
        lines += ["", *_wrapped("written    ", f"{written['file']}: {', '.join(stored)}")]
    if exported := found.get("exported"):
        rows, columns = found["geometry"]["mesh"]
        lines.append(f"exported   {exported}: {columns} x {rows} heights z in tile widths")
    # Warnings without the folders of their files, which the heading names.
    warnings = [
        f"{Path(path).name}: {rest}" for path, _, rest in (w.partition(": ") for w in found["warnings"])
    ]
    for title, texts in (("warnings", warnings), ("remarks", found["oddities"])):
        lines += ["", title] if texts else []
        for text in texts:
            lines += _wrapped("  - ", text)
    return "\n".join(lines)


def _wrapped(head: str, text: str) -> list[str]:
    """Lines of a text behind its head, all of them indented by the width of the head."""
    return textwrap.wrap(text, _WIDTH, initial_indent=head, subsequent_indent=" " * len(head))


def _maps(found: dict[str, Any]) -> list[str]:
    rows = [["map", "file", "size", "kind", "use"]]
    for role, facts in found["maps"].items():
        if role.startswith("bsdf"):
            continue
        name = Path(facts["file"]).name + (f"[{','.join(facts['names'])}]" if facts["names"] else "")
        depth = "float" if facts["bits"] is None else f"{facts['bits']}-bit"
        decoded = ", sRGB decoded" if facts["colorspace"] == "srgb" else ""
        linear = ", linear" if role == "base_color" and not decoded else ""
        size, kind = f"{facts['columns']}x{facts['rows']}", f"{depth} {_KINDS[facts['channels']]}"
        rows.append([role, name, size, kind, USES[role] + decoded + linear])
    for role, value in found["constants"].items():
        if role not in found["maps"]:
            shown = ", ".join(f"{number:.3g}" for number in np.atleast_1d(value))
            rows.append([role, f"constant {shown}", "", "", USES[role]])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    padded = (map(str.ljust, row, widths) for row in rows)
    return [" ".join(cells).rstrip() for cells in padded]


def _unused(found: dict[str, Any]) -> list[str]:
    """Images of the folder that are not used, those of one reason together."""
    reasons: dict[str, list[str]] = {}
    for name, why in found["unused"].items():
        reasons.setdefault(why, []).append(name)
    out = []
    for why, names in reasons.items():
        text = f"{', '.join(names)}: {why}"
        out += _wrapped("not used   ", text)
    return out


def _geometry(found: dict[str, Any]) -> list[str]:
    g, h, file = found["geometry"], found["heights"], found["maps"]["height"]
    u, v = h["repeats"]
    out = [
        f"height     scale {g['height_scale']:.4g} ({g['height_scale_from']}), stored {file['low']:.4g} .. "
        f"{file['high']:.4g}, displacement range {g['displacement_range']:.4g} tile widths",
        f"mesh       {g['mesh'][1]} x {g['mesh'][0]} of {g['map'][1]} x {g['map'][0]} texels, keeps "
        f"{g['slope_kept']:.0%} of the map's RMS slope",
        f"slopes     median {g['slope_median_deg']:.1f}°, 99th percentile {g['slope_p99_deg']:.1f}°, "
        f"steepest {g['slope_max_deg']:.1f}°",
        f"detail     the correlation of heights falls to half within {h['detail_texels']:.1f} texels"
        + (f"; repeats {u} x {v} times" if max(u, v) > 1 else ""),
    ]
    if (codes := h["codes"]) is not None:
        apart = f", {codes['spacing']:.4g} codes apart" if codes["spacing"] > 1 else ""
        out.append(f"values     {codes['levels']} distinct, codes {codes['low']} .. {codes['high']}{apart}")
    if found["tiling"]:
        seams = "; ".join(
            f"along {t['axis']} {'tiles' if t['tiles'] else 'DOES NOT TILE'} ({t['ratio']:.2f})"
            for t in found["tiling"]
        )
        out.append(f"tiling     {seams} (seam / 99th percentile of steps inside)")
        if found["make_tileable"] != "none":
            out.append(f"           before make-tileable {found['make_tileable']}, which closes the seams")
    return out


def _color(found: dict[str, Any]) -> list[str]:
    out = []
    if (a := found["albedo"]) is not None:
        mean = " ".join(f"{c:.2f}" for c in a["mean_rgb"])
        luminance = f"{a['min']:.3f} .. {a['max']:.3f}, median {a['median']:.3f}"
        out.append(f"albedo     mean {mean}, luminance {luminance}")
    if (o := found["opacity"]) is not None:
        out.append(f"opacity    holes {o['holes']:.1%} of the tile, partly transparent {o['partly']:.1%}")
    return out


def _normals(found: dict[str, Any]) -> list[str]:
    n = found["normal"]
    if n is None:
        return []
    tilt = (
        f"normals    {CONVENTION_NAMES[n['convention']]}, tilt median {n['tilt_median_deg']:.1f}°, "
        f"99th percentile {n['tilt_p99_deg']:.1f}°"
    )
    if "best" not in n:
        return [f"{tilt}; nothing to compare with the heights"]
    out = [
        tilt,
        f"           correlation with the heights' slopes: u {signed(n['correlation_u'])}, "
        f"v {signed(n['correlation_v'])}; OpenGL {n['gl']:.2f}, DirectX {n['dx']:.2f}",
    ]
    if n["misfit"]:
        how = f"the {n['image']} map {n['turn']}" if n["turn"] else "heights upside down"
        out.append(f"           DOES NOT FIT; fits with {how}: correlation {n['best']:.2f}")
    elif n["suggested_height_scale"] is not None:
        out.append(
            f"           the normal map suggests the height scale {n['suggested_height_scale']:.3g}; "
            f"in use {found['geometry']['height_scale']:.3g}"
        )
    return out
