"""Material files in YAML: values as people write them, and documents that no reader may accept."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mutations.case import Case, Draws, Rng

# Numbers as they are written, and what YAML 1.2 (core schema) takes them for; None: none in [0, 1].
_WRITTEN: dict[str, float | None] = {
    **dict.fromkeys(("0.25", ".25", "2.5e-1", "25e-2", "+0.25", "0.25 # note", "!!float 0.25"), 0.25),
    **dict.fromkeys(("1", "1.", "0x1"), 1.0),
    **dict.fromkeys(("0", "-0.0"), 0.0),
    **dict.fromkeys(("0,25", "25%", "on", "true", "1/4", "'0.25'", "[0.25]", "{}", "null", "~", "")),
    **dict.fromkeys((".nan", ".inf", "1e400", "-0.25", "1.5", "1:30", "0_1", "2024-01-01")),
    **dict.fromkeys(("!!python/name:os.system",)),
}
_TEXTS = {
    "duplicate": "height: h.npy\nroughness: 0.25\nroughness: 0.75\n",
    "unknown key": "height: h.npy\nroughnes: 0.25\n",
    "tab": "height: h.npy\nroughness:\n\tvalue: 0.25\n",
    "list": "- height: h.npy\n",
    "empty": "",
    "two documents": "height: h.npy\n---\nroughness: 0.25\n",
    "deep": "height: " + "[" * 50_000,
    "NUL": "height: h.npy\n\0",
    "cut": "height: {file: h.npy, scale: ",
    "no such file": "height: gone.npy\n",
    "folder": "height: .\n",
    "tag": "height: !!python/object/apply:os.system ['echo']\n",
}


def make(rng: Rng, folder: Path) -> Case:
    """A material file of constants beside a small height map."""
    d = Draws(rng)
    np.save(folder / "h.npy", np.round(rng.uniform(0, 0.1, (8, 8)), 3))
    path = folder / "material.yaml"
    kind = d.pick(("number", "number", "number", "color", "text", "aliases", "encoding", "cloth", "scale"))
    if kind == "text":
        name = d.pick(_TEXTS)
        path.write_text(_TEXTS[name])
        return Case(path, name, refuse=True)
    if kind == "aliases":
        levels = "".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 9))
        path.write_text("height: h.npy\na0: &a0 [x]\n" + levels)
        return Case(path, "aliases", refuse=True)
    if kind == "encoding":
        name = d.pick(("utf-8-sig", "utf-16", "latin-1", "CRLF"), "encoding")
        text = "# größe\nheight: h.npy\nroughness: 0.25\n"
        path.write_bytes(text.replace("\n", "\r\n").encode() if name == "CRLF" else text.encode(name))
        return Case(path, name, lambda tile: tile.maps["roughness"] == 0.25)
    if kind == "cloth":
        key = d.pick(("yarn: {color: *}", "yarn: {radius: *}", "repeat: *", "fiber: {ior: *}"))
        value = d.pick((".nan", "-1", "1e9", "1" + 30 * "0", "x"))
        path.write_text(f"weave: plain\n{key.replace('*', value)}\n")
        return Case(path, path.read_text(), refuse=True)
    if kind == "scale":
        written = d.pick(("0.5", "-0.5", "1e3", "1e30", ".nan", "0", "x"), "scale")
        path.write_text(f"height: {{file: h.npy, scale: {written}}}\n")
        wanted = float(written) if written[0] in "-01" else float("nan")
        return Case(path, written, lambda tile: tile.height_scale == wanted, not abs(wanted) < 1e6)
    written = d.pick(_WRITTEN, "written")
    number = _WRITTEN[written]
    if kind == "color":
        path.write_text(f"height: h.npy\nbase_color: [0.5, {written.split(' #')[0]}, 0.125]\n")
    else:
        path.write_text(
            f"height: h.npy\n{d.pick(('roughness', 'metallic', 'clearcoat', 'sheen'), 'key')}: {written}\n"
        )
    # Who reads a number in quotes, or an empty key as one that was not given, does no harm.
    harmless = written in ("null", "~", "", "'0.25'", "0x1", "0_1", "[0.25]")
    key = "base_color" if kind == "color" else d.words[-1].split()[-1]

    def check(tile: Any) -> bool | None:
        if number is None:
            return None
        found = tile.maps.get(key)
        return bool(np.allclose(found, (0.5, number, 0.125) if kind == "color" else number, atol=1e-7))

    text = ", ".join(d.words)
    return Case(path, text, check, number is None and not harmless, valid=number is not None and not harmless)
