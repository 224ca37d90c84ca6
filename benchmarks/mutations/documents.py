"""Material files in YAML: values as people write them, and documents that no reader may accept."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mutations.case import Case, Draws

# Numbers as they are written, and what YAML 1.2 (core schema) takes them for; None: none in [0, 1].
_WRITTEN: dict[str, float | None] = {
    **dict.fromkeys(("0.25", ".25", "2.5e-1", "25e-2", "+0.25", "0.25 # note", "!!float 0.25"), 0.25),
    **dict.fromkeys(("1", "1."), 1.0),
    **dict.fromkeys(("0", "-0.0"), 0.0),
    **dict.fromkeys(("0,25", "25%", "on", "true", "1/4", "{}", ".nan", ".inf", "1e400", "-0.25", "1.5")),
    **dict.fromkeys(("1:30", "2024-01-01", "!!python/name:os.system")),
}
_REFUSED = (
    "height: h.npy\nroughness: 0.25\nroughness: 0.75\n",
    "height: h.npy\nroughnes: 0.25\n",
    "height: h.npy\nroughness:\n\tvalue: 0.25\n",
    "- height: h.npy\n",
    "",
    "height: h.npy\n---\nroughness: 0.25\n",
    "height: " + "[" * 50_000,
    "height: h.npy\n\0",
    "height: {file: h.npy, scale: ",
    "height: gone.npy\n",
    "height: .\n",
    "height: !!python/object/apply:os.system ['echo']\n",
    "height: h.npy\na0: &a0 [x]\n" + "".join(f"a{k}: &a{k} [{f'*a{k - 1}, ' * 9}]\n" for k in range(1, 9)),
    *(f"height: {{file: h.npy, scale: {number}}}\n" for number in ("1e30", ".nan", "x")),
    *(f"weave: plain\nyarn: {{radius: {number}}}\n" for number in (".nan", "-1", "1e9", "x")),
    *(f"weave: plain\nrepeat: {number}\n" for number in (".nan", "-1", "1000000000000", "x")),
)


def make(d: Draws, folder: Path) -> Case:
    """A material file of constants beside a small height map."""
    np.save(folder / "h.npy", np.round(d.rng.uniform(0, 0.1, (8, 8)), 3))
    path = folder / "material.yaml"
    kind = d.pick(("number", "number", "color", "refused", "encoding", "scale"))
    if kind == "refused":
        path.write_text(d.pick(_REFUSED))
        d.words.append(path.read_text()[:60])
        return Case(path, refuse=True)
    if kind == "encoding":
        name = d.pick(("utf-8-sig", "utf-16", "latin-1", "utf-8"), "encoding")
        path.write_bytes("# größe\r\nheight: h.npy\r\nroughness: 0.25\r\n".encode(name))
        return Case(path, lambda tile: tile.maps["roughness"] == 0.25)
    if kind == "scale":
        number = d.pick((0.5, -0.5, 1e3), "scale")
        path.write_text(f"height: {{file: h.npy, scale: {number}}}\n")
        return Case(path, lambda tile: tile.height_scale == number)
    written = d.pick(_WRITTEN, "written")
    key = d.pick(("roughness", "metallic", "clearcoat", "sheen")) if kind == "number" else "base_color"
    wanted: Any = _WRITTEN[written]
    refuse = wanted is None
    if kind == "color":
        written, wanted = f"[0.5, {written.split(' #')[0]}, 0.125]", (0.5, wanted, 0.125)
    path.write_text(f"height: h.npy\n{key}: {written}\n")
    return Case(path, lambda tile: bool(np.allclose(tile.maps[key], wanted)), refuse, valid=not refuse)
