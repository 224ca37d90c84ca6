"""The data of :mod:`mbtf_gen.material.inspect` as one screenful of text: at most 45 lines of 100 columns."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

from mbtf_gen.material.checks import CONVENTION_NAMES, signed

WIDTH = 100
LINES = 45
# Room for the material's name in the heading.
_NAME = 48

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
# Where the height scale comes from.
_SOURCES = {"asked": "--height-scale", "material": "material file", "default": "default"}
# Lines, at most, on images that are not used.
_UNUSED_LINES = 8
_KINDS = {1: "gray", 2: "gray+alpha", 3: "RGB", 4: "RGBA"}


def inspection_text(found: dict[str, Any], name: str) -> str:
    """Text for people; the longest lists are cut to keep it on one screen."""
    name = name if len(name) <= _NAME else f"…{name[1 - _NAME :]}"
    given = {*found["maps"], *found["constants"]}
    layers = [text for role, text in (("clearcoat", "a clear coat"), ("sheen", "a sheen")) if role in given]
    surface = f"{found['surface']}{' under ' + ' and '.join(layers) if layers else ''}"
    head = [f"{name}: tile 1 x {found['aspect']:g}, surface {surface}, make-tileable {found['tile']}", ""]
    body = [*_maps(found), *_unused(found), "", *_geometry(found), *_color(found), *_normal(found)]
    room = LINES - len(head) - len(body) - 2
    oddities = _list("remarks", found["oddities"])
    warnings = _list("warnings", [_short(w) for w in found["warnings"]])
    tail = [*warnings, *oddities]
    if len(tail) > room:
        tail = [*tail[: room - 1], "  … more with --json"]
    return "\n".join(_cut(line, WIDTH) for line in ([*head, *body, "", *tail] if tail else [*head, *body]))


def _short(warning: str) -> str:
    """A warning without the folder of its file, which the heading names."""
    path, sign, rest = warning.partition(": ")
    return f"{Path(path).name}: {rest}" if sign and "/" in path else warning


def _list(title: str, texts: list[str]) -> list[str]:
    out = [title] if texts else []
    for text in texts:
        out += textwrap.wrap(text, WIDTH, initial_indent="  - ", subsequent_indent="    ")
    return out


def _cut(text: str, width: int) -> str:
    return text if len(text) <= width else f"{text[: width - 1]}…"


def _maps(found: dict[str, Any]) -> list[str]:
    roles = [role for role in (*found["maps"], *found["constants"]) if not role.startswith("bsdf")]
    first = max(10, *map(len, roles))
    # The names of files give way to long names of roles.
    second = 38 - first
    out = [f"{'map':<{first}} {'file':<{second}} {'size':<11} {'kind':<14} use"]
    for role, facts in found["maps"].items():
        if role.startswith("bsdf"):
            continue
        kind = (
            f"{'float' if facts['bits'] is None else str(facts['bits']) + '-bit'} {_KINDS[facts['channels']]}"
        )
        name = Path(facts["file"]).name + (f"[{','.join(facts['names'])}]" if facts["names"] else "")
        use = USES[role] + (", sRGB decoded" if facts["colorspace"] == "srgb" else "")
        use += ", linear" if role == "base_color" and facts["colorspace"] == "linear" else ""
        size = f"{facts['columns']}x{facts['rows']}"
        name = _cut(name, second)
        out.append(f"{role:<{first}} {name:<{second}} {size:<11} {kind:<14} {_cut(use, 33)}".rstrip())
    for role, value in found["constants"].items():
        if role in found["maps"]:
            continue
        shown = f"{value:g}" if isinstance(value, int | float) else ", ".join(f"{c:.3g}" for c in value)
        out.append(f"{role:<{first}} {'constant ' + shown:<{second + 27}} {USES[role]}")
    return out


def _unused(found: dict[str, Any]) -> list[str]:
    """Images of the folder that are not used, those of one reason together."""
    reasons: dict[str, list[str]] = {}
    for name, why in found["unused"].items():
        reasons.setdefault(why, []).append(name)
    out = []
    for why, names in reasons.items():
        text = f"{', '.join(names)}: {why}"
        out += textwrap.wrap(text, WIDTH, initial_indent="not used   ", subsequent_indent=" " * 11)
    return out if len(out) <= _UNUSED_LINES else [*out[: _UNUSED_LINES - 1], f"{'':<11}… more with --json"]


def _geometry(found: dict[str, Any]) -> list[str]:
    g, h = found["geometry"], found["heights"]
    source = _SOURCES[g["height_from"]]
    u, v = h["repeats"]
    low, high = found["maps"]["height"]["low"], found["maps"]["height"]["high"]
    out = [
        f"height     scale {g['height']:.4g} ({source}), stored {low:.4g} .. {high:.4g}, "
        f"displacement range {g['relief']:.4g} tile widths",
        f"mesh       {g['mesh'][1]} x {g['mesh'][0]} of {g['map'][1]} x {g['map'][0]} texels, keeps "
        f"{g['slope_kept']:.0%} of the map's RMS slope",
        f"slopes     median {g['slope_median_deg']:.1f}°, 99th percentile {g['slope_p99_deg']:.1f}°, "
        f"steepest {g['slope_max_deg']:.1f}°",
        f"detail     the correlation of heights falls to half within {h['detail_texels']:.1f} texels"
        + (f"; repeats {u} x {v} times" if max(u, v) > 1 else ""),
    ]
    if h["codes"] is not None:
        codes = h["codes"]
        apart = f", {codes['spacing']:.4g} codes apart" if codes["spacing"] > 1 else ""
        out.append(f"values     {codes['levels']} distinct, codes {codes['low']} .. {codes['high']}{apart}")
    if found["tiling"]:
        seams = "; ".join(
            f"along {t['axis']} {'tiles' if t['tiles'] else 'DOES NOT TILE'} ({t['ratio']:.2f})"
            for t in found["tiling"]
        )
        out.append(f"tiling     {seams} (seam / 99th percentile of steps inside)")
    return out


def _color(found: dict[str, Any]) -> list[str]:
    out = []
    a, o = found["albedo"], found["opacity"]
    if a is not None:
        low, high = a["plausible"]
        out.append(
            f"albedo     luminance {a['min']:.3f} .. {a['max']:.3f}, median {a['median']:.3f}; "
            f"{a['share_above']:.2%} above {high}, {a['share_below']:.2%} below {low}"
        )
    if o is not None:
        out.append(f"opacity    holes {o['holes']:.1%} of the tile, partly transparent {o['partly']:.1%}")
    return out


def _normal(found: dict[str, Any]) -> list[str]:
    n = found["normal"]
    if n is None:
        return []
    out = [
        f"normals    {CONVENTION_NAMES[n['convention']]}, tilt median {n['tilt_median_deg']:.1f}°, "
        f"99th percentile {n['tilt_p99_deg']:.1f}°"
    ]
    if "best" not in n:
        return [f"{out[0]}; nothing to compare with the heights"]
    out.append(
        f"           correlation with the heights' slopes: u {signed(n['correlation_u'])}, "
        f"v {signed(n['correlation_v'])}; OpenGL {n['gl']:.2f}, DirectX {n['dx']:.2f}"
    )
    if n["misfit"]:
        how = f"the {n['image']} map {n['turn']}" if n["turn"] else "heights upside down"
        out.append(f"           DOES NOT FIT; fits with {how}:")
        out.append(f"           correlation {n['best']:.2f}, next best {n['runner_up']:.2f}")
    elif n["suggested_height"] is not None:
        out.append(
            f"           the normal map suggests the height scale {n['suggested_height']:.3g}; "
            f"in use {n['height_in_use']:.3g}"
        )
    return out
