"""The statistics of a height field, which :meth:`HeightFieldTile.inspect` collects, as text for people."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_gen.tile.maps.checks import CONVENTION_NAMES, far_off, signed
from mbtf_gen.tile.maps.material_file import ROLES, layers_above
from mbtf_gen.tile.protocol import brief_warnings

# Luminance from charcoal to fresh snow; outside, a color map is probably not albedo.
ALBEDO_RANGE = (0.02, 0.95)
# Fraction of the map's RMS slope below which a mesh is reported.
_KEPT = 0.9
# Texels above which few distinct floats indicate quantization.
_MANY = 4096
# Width to which long texts are wrapped.
_WIDTH = 100

# What each map does to the simulation.
USES = {"height": "displaces the mesh", **{name: role.use for name, role in ROLES.items()}}
_KINDS = {1: "gray", 2: "gray+alpha", 3: "RGB", 4: "RGBA"}


def oddities(found: Mapping[str, Any]) -> list[str]:
    """Unusual properties in words."""
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
    if albedo["share_above"] > 1e-3:
        out.append(f"{albedo['share_above']:.1%} of the albedo lies above {high}: brighter than snow")
    if albedo["share_below"] > 0.5:
        out.append(f"{albedo['share_below']:.0%} of the albedo lies below {low}: blacker than coal")
    return out


def inspection_text(found: Mapping[str, Any], name: str) -> str:
    """The data of :func:`inspect` as text for people."""
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
    # The most important one comes last.
    scale, others = found["scale_warning"], [w for w in found["warnings"] if w != found["scale_warning"]]
    for title, texts in (("warnings", brief_warnings(others)), ("remarks", found["oddities"])):
        lines += ["", title] if texts else []
        for text in texts:
            lines += _wrapped("  - ", text)
    lines += ["", f"warning: {brief_warnings([scale])[0]}"] if scale is not None else []
    return "\n".join(lines)


def _wrapped(head: str, text: str) -> list[str]:
    """Lines of a text behind its head, all of them indented by the width of the head."""
    return textwrap.wrap(text, _WIDTH, initial_indent=head, subsequent_indent=" " * len(head))


def _maps(found: Mapping[str, Any]) -> list[str]:
    rows = [["map", "file", "size", "kind", "use"]]
    for role, facts in found["maps"].items():
        if role.startswith("bsdf"):
            continue
        name = Path(facts["file"]).name + (f"[{','.join(facts['names'])}]" if facts["names"] else "")
        depth = "float" if facts["bits"] is None else f"{facts['bits']}-bit"
        space = facts["colorspace"]
        decoded = {"srgb": ", sRGB decoded", "linear": ""}.get(space, f", converted from {space}")
        decoded += ", inverted" if facts["inverted"] else ""
        linear = ", linear" if role == "base_color" and not decoded else ""
        size, kind = f"{facts['columns']}x{facts['rows']}", f"{depth} {_KINDS[facts['channels']]}"
        rows.append([role, name, size, kind, USES[role] + decoded + linear])
    for role, value in found["constants"].items():
        if role not in found["maps"]:
            numbers = np.atleast_1d(value)
            gray = numbers[:1] if np.ptp(numbers) == 0 else numbers
            shown = ", ".join(f"{number:.3g}" for number in gray)
            rows.append([role, f"constant {shown}", "", "", USES[role]])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    padded = (map(str.ljust, row, widths) for row in rows)
    return [" ".join(cells).rstrip() for cells in padded]


def _unused(found: Mapping[str, Any]) -> list[str]:
    """Images of the folder that are not used, those of one reason together."""
    reasons: dict[str, list[str]] = {}
    for name, why in found["unused"].items():
        reasons.setdefault(why, []).append(name)
    out = []
    for why, names in reasons.items():
        text = f"{', '.join(names)}: {why}"
        out += _wrapped("not used   ", text)
    return out


def _geometry(found: Mapping[str, Any]) -> list[str]:
    g, h, file = found["geometry"], found["heights"], found["maps"]["height"]
    out = [
        f"height     scale {g['height_scale']:.4g} ({g['height_scale_from']}), stored {file['low']:.4g} .. "
        f"{file['high']:.4g}, displacement range {g['displacement_range']:.4g} tile widths",
        f"mesh       {g['mesh'][1]} x {g['mesh'][0]} of {g['map'][1]} x {g['map'][0]} texels, keeps "
        f"{g['slope_kept']:.0%} of the map's RMS slope",
        f"slopes     median {g['slope_median_deg']:.1f}°, 99th percentile {g['slope_p99_deg']:.1f}°, "
        f"steepest {g['slope_max_deg']:.1f}°",
    ]
    if (codes := h["codes"]) is not None:
        apart = f", {codes['spacing']:.4g} codes apart" if codes["spacing"] > 1 else ""
        out.append(f"values     {codes['levels']} distinct, codes {codes['low']} .. {codes['high']}{apart}")
    if found["tiling"]:
        axes = ", ".join(f"along {t['axis']} {'yes' if t['tiles'] else 'NO'}" for t in found["tiling"])
        steps = " and ".join(f"{t['ratio']:.2g}" for t in found["tiling"])
        out.append(f"tiling     {axes}; steps across the border are {steps} times the 99th percentile inside")
        if found["make_tileable"] != "none":
            out.append(f"           before make-tileable {found['make_tileable']}, which closes the seams")
    return out


def _color(found: Mapping[str, Any]) -> list[str]:
    out = []
    if (a := found["albedo"]) is not None:
        mean = " ".join(f"{c:.2f}" for c in a["mean_rgb"])
        luminance = f"{a['min']:.3f} .. {a['max']:.3f}, median {a['median']:.3f}"
        out.append(f"albedo     mean {mean}, luminance {luminance}")
    if (o := found["opacity"]) is not None:
        out.append(f"opacity    holes {o['holes']:.1%} of the tile, partly transparent {o['partly']:.1%}")
    return out


def _normals(found: Mapping[str, Any]) -> list[str]:
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
    elif (scale := n["suggested_height_scale"]) is not None:
        # A warning names a scale that is far off.
        if not far_off(found["geometry"]["height_scale"], scale):
            out.append(
                f"           slopes agree best at --height-scale {scale:.3g}; "
                f"{found['geometry']['height_scale']:.3g} is in use"
            )
    else:
        out.append("           at no height scale do the slopes agree: the normal map shows other details")
    return out
