"""Texture sets in the customary names of sites and programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mutations.case import Case, Draws, encoded, linear, quarters

# The form of a style's file names, {b} being the material's name and {r} its resolution, and its maps. Packed
# maps name their channels; "-x" is 1 - x; "dx" a normal map with green down; "" is not used.
_STYLES = {
    "ambientCG": "{b}_{r}-JPG_{m}.jpg Color=color Displacement=height NormalGL=normal NormalDX=dx "
    "Roughness=rough Metalness=metal AO=",
    "Poly Haven": "{b}_{m}_{r}.png diff=color disp=height nor_gl=normal rough=rough ao=",
    "Poly Haven arm": "{b}_{m}_{r}.png diff=color disp=height arm=,rough,metal",
    "Poliigon old": "{b}_{m}_{r}.png COL_VAR1=color COL_VAR2= DISP= DISP16=height NRM=normal GLOSS=-rough "
    "REFL=",
    "Poliigon": "Poliigon_{b}_{m}.jpg BaseColor=color Displacement=height Normal=normal Roughness=rough "
    "Metallic=metal AmbientOcclusion=",
    "Megascans": "{b}_{r}_{m}.jpg Albedo=color Displacement=height Normal=normal Roughness=rough AO= Cavity= "
    "Bump= Specular= Gloss=",
    "Substance": "{b}_{m}.png Base_Color=color Height=height Normal_OpenGL=normal Roughness=rough "
    "Metallic=metal Mixed_AO=",
    "Substance packed": "{b}_{m}.png Base_Color=color Height=height Normal_DirectX=dx "
    "OcclusionRoughnessMetallic=,rough,metal",
    "Unity HDRP": "{b}_{m}.png BaseMap=color Height=height Normal=normal MaskMap=metal,,,-rough",
    "Unity": "{b}_{m}.png AlbedoTransparency=color Height=height MetallicSmoothness=metal,,,-rough",
    "Unreal": "T_{b}_{m}.png BaseColor=color H=height N=dx ORM=,rough,metal",
    "cgbookcase": "{b}_{r}_{m}.jpg BaseColor=color Height=height Normal=normal Roughness=rough AO=",
    "FreePBR": "{b}-{m}.png albedo=color height=height normal-ogl=normal metallic=metal ao= preview=",
    "3dtextures": "{b}_005_{m}.jpg basecolor=color height=height normal=normal ambientOcclusion=",
    "Textures.com": "TexturesCom_{b}_2x2_{r}_{m}.tif albedo=color height=height roughness=rough ao=",
    "RMA": "{b}_{m}.png albedo=color height=height normal_gl=normal RMA=rough,metal,",
    "MRAO": "{b}_{m}.png diffuse=color height=height MRAO=metal,rough,",
    "gloss": "{b}_{m}.png diffuse=color displacement=height glossiness=-rough specular=",
}
_NAMES = ("rock_wall_08", "Metal032", "Ground Grass", "ColorTiles", "RoughPlaster", "NormalBrick", "ue4kfcqs")
_ROLES = {"color": "base_color", "rough": "roughness", "metal": "metallic", "normal": "normal"}


def make(d: Draws, folder: Path) -> Case:
    """A folder of maps with distinct contents; what a map's name defines is used, or said not to be."""
    form, *maps = _STYLES[d.pick(_STYLES, "names of")].split(" ")
    words = {"b": d.pick(_NAMES, "of"), "r": d.pick(("1K", "2k", "4K"))}
    height = np.kron(d.rng.integers(60, 200, (4, 4)), np.ones((4, 4)))
    slopes = [(np.roll(height, 1, a) - np.roll(height, -1, a)) / 400 for a in (1, 0)]
    normal = np.stack([slopes[0], -slopes[1], np.ones((16, 16))], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    codes: dict[str, Any] = {name: quarters(d.rng)[..., 0] for name in ("rough", "metal", "")}
    codes |= {"color": quarters(d.rng), "height": height, "normal": np.rint(127.5 * normal + 127.5)}
    codes["-rough"] = 255 - codes["rough"]
    codes["dx"] = np.abs(codes["normal"] - (0, 255, 0))
    wanted = {"base_color": linear(codes["color"] / 255.0), "normal": codes["normal"] / 127.5 - 1}
    wanted |= {"roughness": codes["rough"] / 255.0, "metallic": codes["metal"] / 255.0}
    names: dict[str, str] = {}
    dropped = d.pick(maps) if d.chance(0.3) else ""
    for entry in maps:
        word, content = entry.split("=")
        if entry == dropped and content != "height":
            d.words.append(f"without {word}")
            continue
        name = form.format(**words, m=word)
        parts = content.split(",")
        image = np.stack([codes[part] for part in parts], axis=-1) if len(parts) > 1 else codes[content]
        kind = {"jpg": "JPEG", "tif": "TIFF", "png": "PNG"}[name[-3:]]
        (folder / name).write_bytes(encoded(image.astype(np.uint8), kind))
        names |= {part.removeprefix("-").replace("dx", "normal"): name for part in parts}

    def check(tile: Any) -> bool:
        said = " ".join([*tile.warnings, *tile.unused])
        for content, role in _ROLES.items():
            found = tile.maps.get(role)
            if content not in names:
                # A map in the place of another, or a number in its place.
                if np.ndim(found) > 1:
                    return False
            elif np.shape(found)[:2] != (16, 16):
                if names[content] not in said:
                    return False
            elif np.abs(found - wanted[role]).mean() > (0.1 if role == "normal" else 0.02):
                return False
        return np.ndim(tile.maps.get("opacity")) < 2 and tile.files["height"].name == names["height"]

    return Case(folder, check)
