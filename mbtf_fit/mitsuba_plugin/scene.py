"""Loading of scenes with fitted materials, and what can be said against them before they are rendered."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi

from mbtf_core.errors import InputError, MbtfError
from mbtf_fit.mitsuba_plugin import registration


def load_scene(source: str | Path | Mapping[str, Any]) -> Any:
    """Load a scene and check it: a dictionary, an XML file's path, or XML text.

    Mitsuba wraps errors of plugins into a report of several lines; this raises the plugin's own.

    Raises
    ------
    MbtfError : what is wrong with a material, or a mesh with an ``mbtf`` material has no texture coordinates
    """
    registration.register()
    registration.last_error = None
    try:
        if isinstance(source, Mapping):
            scene = mi.load_dict(dict(source))
        elif str(source).lstrip().startswith("<"):
            scene = mi.load_string(str(source))
        else:
            scene = mi.load_file(str(source))
    except Exception:
        error: MbtfError | None = registration.last_error
        if error is None:
            raise
        raise error from None
    if isinstance(scene, mi.Scene):
        check_scene(scene)
    return scene


def check_scene(scene: Any) -> None:
    """Refuse meshes that have an ``mbtf`` material but no texture coordinates.

    Raises
    ------
    InputError : such a mesh
    """
    from mbtf_fit.mitsuba_plugin.bsdf import MbtfBSDF

    for shape in scene.shapes():
        if shape.is_mesh() and isinstance(shape.bsdf(), MbtfBSDF) and not shape.has_vertex_texcoords():
            raise InputError(
                "the mesh has an mbtf material but no texture coordinates",
                where=f"shape '{shape.id()}'",
                hint="give it uv coordinates: they place the material's tile",
            )
