"""Registration of the plugins with Mitsuba, and loading of scenes with fitted materials."""

from __future__ import annotations

import logging
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mbtf_core.errors import EngineError, MbtfError, UsageError
from mbtf_fit.backends.mitsuba.names import BSDF_NAME, INTEGRATOR_NAME, VARIANTS
from mbtf_gen.engine.runtime import CPU_VARIANT, load_mitsuba, refuse_old_llvm
from mbtf_gen.engine.types import Properties, Scene

_log = logging.getLogger(__name__)
# The variant whose classes the plugins derive from.
_registered: str | None = None
# The last error of a plugin's constructor. Mitsuba may construct plugins in its own threads, and passes on
# the text of their exceptions only.
_last_error: MbtfError | None = None


def variant_is_set() -> bool:
    """Whether this process has set a variant of Mitsuba."""
    mitsuba = sys.modules.get("mitsuba")
    return mitsuba is not None and mitsuba.variant() is not None


def register(variant: str | None = None) -> None:
    """Register ``mbtf`` and ``mbtf_path`` with Mitsuba; a second call does nothing.

    Parameters
    ----------
    variant : str, optional
        Load Mitsuba with this variant first: ``llvm_ad_rgb``, ``cuda_ad_rgb`` or ``auto``. Dr.Jit then uses
        the LLVM of this installation; without it, Mitsuba must be imported and its variant set, and Dr.Jit
        uses the LLVM of the system.

    Raises
    ------
    UsageError
        No variant is set, or one that the plugins do not support.
    EngineError
        The plugins are registered with another variant, or Mitsuba or its LLVM cannot be used.
    """
    global _registered
    if variant is not None:
        load_mitsuba(variant)
    if not variant_is_set():
        raise UsageError(
            "no variant of Mitsuba is set", hint=f'call mbtf_fit.backends.mitsuba.register("{CPU_VARIANT}")'
        )
    import mitsuba as mi

    current = mi.variant()
    if current == _registered:
        return
    if current not in VARIANTS:
        raise UsageError(
            f"the plugin '{BSDF_NAME}' does not run in the variant {current}",
            hint=f"set {VARIANTS[0]} or {VARIANTS[1]}",
        )
    if _registered is not None:
        raise EngineError(
            f"the plugin '{BSDF_NAME}' is registered with the variant {_registered}",
            hint="use one variant per process",
        )
    if current == CPU_VARIANT:
        refuse_old_llvm()
    from mbtf_fit.backends.mitsuba.bsdf import MbtfBSDF
    from mbtf_fit.backends.mitsuba.integrator import ConePath

    mi.register_bsdf(BSDF_NAME, lambda props: _construct(MbtfBSDF, props))
    mi.register_integrator(INTEGRATOR_NAME, lambda props: _construct(ConePath, props))
    _registered = current


def _construct(plugin: Any, props: Properties) -> Any:
    global _last_error
    try:
        return plugin(props)
    except MbtfError as error:
        _last_error = error
        raise


def load_scene(
    source: str | Path | Mapping[str, Any], *, clamp_environment: bool = False, **parameters: Any
) -> Scene:
    """Load and check a scene with fitted materials; errors of the plugins are raised as they are.

    Parameters
    ----------
    source : str, Path or mapping
        Path of an XML file, XML text, or a dictionary as for ``mitsuba.load_dict``.
    clamp_environment : bool
        Set texels of the environment map that are negative or not finite to 0.
    **parameters
        For Mitsuba's loader: values of the ``$name`` in XML.

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

    from mbtf_fit.backends.mitsuba.bsdf import check_scene

    global _last_error
    _last_error = None
    try:
        if isinstance(source, Mapping):
            scene = mi.load_dict(dict(source), **parameters)
        elif str(source).lstrip().startswith("<"):
            scene = mi.load_string(str(source), **parameters)
        else:
            scene = mi.load_file(str(source), **parameters)
    except Exception:
        error, _last_error = _last_error, None
        if error is None:
            raise
        raise error from None
    if isinstance(scene, mi.Scene):
        check_scene(scene)
        _check_environment(scene, clamp_environment)
    return scene


def _check_environment(scene: Scene, clamp: bool) -> None:
    """Set texels of an environment map that are no radiance, such as resampling leaves, to 0, or warn of
    them."""
    import mitsuba as mi
    import numpy as np

    emitter = scene.environment()
    data = mi.traverse(emitter) if emitter is not None else {}
    if "data" not in data:
        return
    texels = np.array(data["data"])
    bad = ~(np.isfinite(texels) & (texels >= 0)).all(axis=-1)
    if bad.any() and clamp:
        data["data"] = mi.TensorXf(np.where(np.isfinite(texels), np.maximum(texels, 0.0), 0.0))
        data.update()
    elif bad.any():
        _log.warning(
            "the environment map '%s' has texels that are negative or not finite (%.2g%%, the lowest %.3g): "
            "they darken the picture; load_scene(..., clamp_environment=True) sets them to 0",
            emitter.id(),
            100.0 * bad.mean(),
            np.nanmin(texels),
        )
