"""The material of the report: thumbnails of its maps, and what ``mbtf-gen inspect`` says of it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.color import linear_to_srgb
from mbtf_core.errors import MbtfError
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.tile.inspection import USES
from mbtf_gen.tile.loading import latest_material
from mbtf_pipeline.report.embed import U8, Pixels, jpeg_uri, shrink

# Largest width and height of a thumbnail, pixels, and its JPEG quality.
_SIZE, _QUALITY = 192, 85


def material_section(config: GeneratorConfig, inputs: Mapping[str, str]) -> dict[str, Any]:
    """Describe the material of a data set.

    Parameters
    ----------
    config : configuration of the data set
    inputs : digests of the material's files when it was generated

    Returns
    -------
    maps : a figure of each map
    warnings : of the material and of its maps
    inspection : text of ``mbtf-gen inspect``
    missing : why there is nothing of it; empty otherwise
    """
    nothing = {"maps": [], "warnings": [], "inspection": ""}
    geometry = config.geometry
    try:
        material = latest_material(config.material, geometry.make_tileable)
        found = material.inspect(geometry)
        text = material.describe(found, config.material)
    except (MbtfError, OSError) as error:
        return nothing | {"missing": f"The material cannot be read any more: {error}"}
    if material.digests != inputs:
        return nothing | {"missing": f"{config.material} has changed since the data set was generated."}
    maps = []
    for role, facts in found.get("maps", {}).items():
        value = material.images.get(role)
        if value is None or np.ndim(value) < 2:
            continue
        name, title = Path(facts["file"]).name, role.replace("_", " ").capitalize()
        lines = [name, f"{facts['columns']} × {facts['rows']}, {USES[role]}"]
        if role == "height":
            lines.append(f"{facts['low']:.4g} (black) to {facts['high']:.4g} (white)")
        image = jpeg_uri(_thumbnail(role, np.asarray(value)), _QUALITY)
        alt = f"{title}: {name}"
        maps.append({"label": title, "lines": lines, "image": image, "alt": alt, "file": ""})
    # Without the folders of their files.
    parts = (warning.partition(": ") for warning in found["warnings"])
    warnings = [f"{Path(path).name}: {text}" for path, _, text in parts] + found.get("oddities", [])
    return {"maps": maps, "warnings": warnings, "inspection": text, "missing": ""}


def _thumbnail(role: str, value: Pixels) -> U8:
    """A thumbnail: colors as sRGB, normals from [-1, 1], heights from their range, other maps as stored."""
    small: Pixels = shrink(value, -(-max(value.shape[:2]) // _SIZE)).astype(np.float64)
    if role.endswith("color"):
        small = linear_to_srgb(np.clip(small, 0.0, 1.0))
    elif role == "normal":
        small = 0.5 + 0.5 * small
    elif role == "height":
        low, high = value.min(), value.max()
        small = (small - low) / (high - low if high > low else 1.0)
    if small.ndim == 2:
        small = np.repeat(small[..., None], 3, axis=-1)
    return np.round(255.0 * np.clip(small, 0.0, 1.0)).astype(np.uint8)
