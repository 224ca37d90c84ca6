"""Loading of scenes with fitted materials."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mbtf_fit.mitsuba_plugin.registration import register, take_last_error
from mbtf_gen.render.types import Scene


def load_scene(source: str | Path | Mapping[str, Any]) -> Scene:
    """Load and check a scene with fitted materials; errors of the plugins are raised as they are.

    Parameters
    ----------
    source : str, Path or mapping
        Path of an XML file, XML text, or a dictionary as for ``mitsuba.load_dict``.

    Returns
    -------
    mitsuba.Scene
        Or the object that a dictionary describes.

    Raises
    ------
    MbtfError
        A material cannot be used, or a mesh with an ``mbtf`` material has no texture coordinates.
    """
    register()
    import mitsuba as mi

    from mbtf_fit.mitsuba_plugin.bsdf import check_scene

    take_last_error()
    try:
        if isinstance(source, Mapping):
            scene = mi.load_dict(dict(source))
        elif str(source).lstrip().startswith("<"):
            scene = mi.load_string(str(source))
        else:
            scene = mi.load_file(str(source))
    except Exception:
        error = take_last_error()
        if error is None:
            raise
        raise error from None
    if isinstance(scene, mi.Scene):
        check_scene(scene)
    return scene
